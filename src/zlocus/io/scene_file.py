"""Open scenes: a list of images with their own RPCs, or one `scene.yaml` (schema 1):

schema: 1
frame: {crs: "EPSG:32631"}             # optional: else the UTM zone; or {local: true, up: [x, y, z], north: [x, y, z]}
area: {bounds: [xmin, ymin, xmax, ymax]}   # optional, in that CRS
heights: [zmin, zmax]                  # optional, ellipsoidal metres
views:
  - name: nadir
    image: img_n1.tif                  # relative to this file
    camera: {kind: rpc, file: other_RPC.TXT, shift: [0.3, -1.2]}   # file and shift are optional
    date: 2026-05-17                   # optional: images of near dates are matched first
    mask: clouds.tif                   # optional: pixels that show no ground
"""

from __future__ import annotations

import datetime
import unicodedata
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
from pydantic import Field, SerializeAsAny, field_validator, model_validator
from pyproj import CRS
from pyproj.exceptions import CRSError

from zlocus.core.errors import ConfigError, InputError, ZlocusError
from zlocus.core.quoting import quoted
from zlocus.core.scene import Acquisition, Scene, View, held_window, is_local
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.io.atomic_write import write_atomically
from zlocus.io.cameras.camera_entry import CameraEntry, OpenedCamera, Vector
from zlocus.io.cameras.camera_kinds import CAMERA_KINDS, RpcCamera, RpcSource
from zlocus.io.cameras.frame_camera import FrameCamera
from zlocus.io.cameras.shared_rpc import ImageRpc, shared_rpc_message, shared_rpcs
from zlocus.io.colour_entry import ColourEntry
from zlocus.io.crs import check_fits, checked_crs, local_frame, utm_zone
from zlocus.io.deliveries.delivered_image import RefusedProduct
from zlocus.io.images import (
    RasterImage,
    check_content,
    check_grey_values,
    check_last_block,
    open_header,
    with_plateau,
)
from zlocus.io.masks.ground_polygons import GroundView
from zlocus.io.masks.mask_entry import MaskEntries
from zlocus.io.masks.open_mask import open_masks
from zlocus.io.open_raster import existing_file
from zlocus.io.resolved_entry import ResolvedEntry, entries_of
from zlocus.io.safe_documents import read_yaml
from zlocus.io.schema import FiniteNumber, StrictModel, validate_document
from zlocus.sensors.frame import FrameModel
from zlocus.sensors.frame_axes import is_along, rotation_to_axes

SCENE_SUFFIXES = (".yaml", ".yml")
T = TypeVar("T")


class Frame(StrictModel):
    """The frame of all views: a CRS, or local Cartesian axes in metres with z up.

    up : direction, in the axes of the cameras, that becomes z of a local frame; north : direction whose part at right
    angles to `up` becomes y. Without `north` the smallest rotation is used.
    """

    crs: str | None = None
    local: Literal[True] | None = None
    up: Vector | None = None
    north: Vector | None = None

    @model_validator(mode="after")
    def _either(self) -> Frame:
        if (self.crs is None) == (self.local is None):
            raise ValueError("give either crs: EPSG:n or local: true")
        if self.up is not None and not self.local:
            raise ValueError("up is for local: true; where there is a CRS, up is along the ellipsoid's normal")
        if self.up is not None and not any(self.up):
            raise ValueError("up is a direction: one of its three numbers is not 0")
        if self.north is not None and self.up is None:
            raise ValueError("north needs up, which says about what the frame is turned: add up: [x, y, z]")
        if self.up is not None and self.north is not None and is_along(self.up, self.north):
            raise ValueError("north is a direction at an angle to up: give one that is neither along up nor 0")
        return self


class Area(StrictModel):
    """The area of interest. bounds : xmin, ymin, xmax, ymax in the frame's CRS."""

    bounds: tuple[FiniteNumber, FiniteNumber, FiniteNumber, FiniteNumber]

    @model_validator(mode="after")
    def _ordered(self) -> Area:
        xmin, ymin, xmax, ymax = self.bounds
        if not (xmin < xmax and ymin < ymax):
            raise ValueError("bounds are xmin, ymin, xmax, ymax with xmin < xmax and ymin < ymax")
        return self


class ViewEntry(StrictModel):
    """An image and its camera.

    name : unique in the scene; date : of the exposure, None for what the image says; mask : pixels that show no ground;
    colours : another image that gives its colours.
    """

    name: str = Field(min_length=1)
    image: str
    camera: SerializeAsAny[CameraEntry]
    date: datetime.date | None = None
    mask: MaskEntries | None = None
    colours: ColourEntry | None = None

    @field_validator("name")
    @classmethod
    def _shows(cls, name: str) -> str:
        if any(unicodedata.category(sign) == "Cc" for sign in name):
            raise ValueError("a name has no control characters, which change what a terminal shows")
        return name


class SceneFile(StrictModel):
    """A `scene.yaml`, schema 1."""

    schema_version: Literal[1] = Field(alias="schema")
    frame: Frame | None = None
    area: Area | None = None
    heights: tuple[FiniteNumber, FiniteNumber] | None = None
    views: tuple[ViewEntry, ...]

    @model_validator(mode="after")
    def _consistent(self) -> SceneFile:
        if self.heights is not None and not self.heights[0] < self.heights[1]:
            raise ValueError("heights are zmin, zmax with zmin < zmax")
        for name, count in Counter(view.name for view in self.views).items():
            if count > 1:
                raise ValueError(f"the view name {name!r} is used twice")
        if self.area is not None and self.frame is None:
            raise ValueError("area needs frame: {crs: EPSG:n}, whose coordinates its bounds are")
        frame_cameras = [view.camera for view in self.views if isinstance(view.camera, FrameCamera)]
        if self.frame is not None and self.frame.local:
            if any(isinstance(view.camera, RpcCamera) for view in self.views):
                raise ValueError("frame is local, but an RPC knows its place on the Earth: write frame: {crs: EPSG:n}")
            if any(camera.crs or camera.earth for camera in frame_cameras):
                raise ValueError("frame is local, where a camera has no crs and no earth: write frame: {crs: EPSG:n}")
            if self.frame.up is not None and len(frame_cameras) < len(self.views):
                raise ValueError("up turns frame cameras only: give the others in axes whose z is up")
        if len({camera.earth or "curved" for camera in frame_cameras}) > 1:
            raise ValueError("some cameras have earth: flat and some not: they do not fit together, choose one for all")
        return self


def open_scene(
    inputs: Sequence[Path], crs: CRS | None = None, chosen: Callable[[Scene], Scene] | None = None, least: int = 2
) -> Scene:
    """Open the scene of some images with RPCs, or of one `scene.yaml`.

    crs : a projected CRS in metres, whose horizontal part becomes the frame. It overrides the CRS of the file. The
    default is the WGS84 UTM zone of the scene's centre. chosen : for the scene of all views, of which only headers and
    cameras have been read, it returns the scene of the wanted views, whose pixels alone are read. least : of images.

    Raises
    ------
    InputError
        A file is missing, damaged or given twice; an image is empty, constant, without a camera or with that of another
        one; there are too few images.
    ConfigError
        The CRS is not projected in metres.
    """
    scene_input = _inputs_of_scene(inputs, crs)
    opened = [_open_view(entry, scene_input.folder) for entry in scene_input.entries]
    if len(opened) < least:
        found = f"only {opened[0].entry.path} was found" if opened else "none was given"
        raise InputError(f"A surface needs two images or more: {found}. Add images of the same ground.")
    for one, other in _with_shared_rpcs(opened):
        raise InputError(shared_rpc_message(one.entry.path, other.entry.path))
    frame = _frame_of(opened, scene_input.crs)
    scene = scene_input.scene([each.view(frame) for each in opened], frame)
    scene = scene if chosen is None else chosen(scene)
    return replace(scene, views=tuple(map(_with_checked_image, scene.views)))


@dataclass(frozen=True)
class RefusedView:
    """A view that cannot be used. reason : why, as a sentence."""

    name: str
    path: Path
    reason: str


@dataclass(frozen=True)
class UsableViews:
    """The usable views of a scene. scene : of these, None where there is none; refused : the other views."""

    scene: Scene | None
    refused: tuple[RefusedView, ...]


def open_usable_views(inputs: Sequence[Path], crs: CRS | None = None) -> UsableViews:
    """As `open_scene`, but views that cannot be used, or whose entry is wrong, are listed, not raised.

    Raises
    ------
    InputError, ConfigError
        No view can be opened: the scene file has another fault, an image is given twice, or the CRS is not usable.
    """
    refused_entries: list[RefusedView] = []
    scene_input = _inputs_of_scene(inputs, crs, refused_entries)
    refused_by_name: dict[str, RefusedView] = {}

    def attempt(entry: ResolvedEntry, step: Callable[[], T]) -> list[T]:
        try:
            return [step()]
        except ZlocusError as error:
            refused_by_name[entry.name] = RefusedView(entry.name, entry.path, str(error))
            return []

    opened = [
        each
        for entry in scene_input.entries
        for each in attempt(entry, partial(_open_checked_view, entry, scene_input.folder))
    ]
    for pair in _with_shared_rpcs(opened):
        reason = shared_rpc_message(*(each.entry.path for each in pair))
        refused_by_name |= {each.entry.name: RefusedView(each.entry.name, each.entry.path, reason) for each in pair}
    opened = [each for each in opened if each.entry.name not in refused_by_name]
    frame = scene_input.crs
    if frame is None:
        opened = [each for each in opened if attempt(each.entry, partial(_mean_centre, [each]))]
        frame = _frame_of(opened, None) if opened else None
    views = (
        [] if frame is None else [v for each in opened for v in attempt(each.entry, partial(_masked_view, each, frame))]
    )
    scene = scene_input.scene(views, frame) if views and frame is not None else None
    refused = [refused_by_name[entry.name] for entry in scene_input.entries if entry.name in refused_by_name]
    return UsableViews(scene, (*refused_entries, *refused))


def read_scene_file(path: Path, refused: list[RefusedView] | None = None) -> SceneFile:
    """Read and check a `scene.yaml`, without opening its images and cameras.

    refused : list to which views with a wrong entry are added, and the file is read without them; None: they are
    errors.

    Raises
    ------
    InputError
        The file is wrong; the message names the key and what is allowed.
    """
    path = existing_file(path, "scene file")
    document = read_yaml(path)
    if not isinstance(document, dict):
        raise InputError(f"{path} is not a scene file: it must hold schema: 1 and a list of views.")
    views = document.get("views")
    if isinstance(views, list):
        document |= {"views": [entry for i in range(len(views)) for entry in _view_entry(views, i, path, refused)]}
    return validate_document(SceneFile, document, path)


def _view_entry(views: list[Any], index: int, path: Path, refused: list[RefusedView] | None) -> list[ViewEntry]:
    """The entry of a view of a scene file as a list; empty where it was added to `refused`."""
    view, where = views[index], f"views[{index}]"
    given = view if isinstance(view, dict) else {}
    try:
        if "camera" in given:
            view = given | {"camera": _camera(given["camera"], path, f"{where}.camera")}
        return [validate_document(ViewEntry, view, path, where)]
    except InputError as error:
        if refused is None:
            raise
        name, image = given.get("name"), given.get("image")
        is_unique = isinstance(name, str) and sum(isinstance(v, dict) and v.get("name") == name for v in views) == 1
        file = path.parent / image if isinstance(image, str) else path
        refused.append(RefusedView(name if isinstance(name, str) and is_unique else where, file, str(error)))
        return []


def write_scene_file(path: Path, scene_file: SceneFile) -> None:
    """Write a `scene.yaml` atomically.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    document = scene_file.model_dump(mode="json", by_alias=True, exclude_none=True)
    text = yaml.safe_dump(document, sort_keys=False)
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))


@dataclass(frozen=True)
class _SceneInput:
    """A scene before any image is opened. folder : base of relative paths of cameras; up, north : see `Frame`."""

    entries: tuple[ResolvedEntry, ...]
    folder: Path
    crs: CRS | None
    bounds: tuple[float, float, float, float] | None = None
    heights: tuple[float, float] | None = None
    up: tuple[float, float, float] | None = None
    north: tuple[float, float, float] | None = None

    def scene(self, views: Sequence[View], crs: CRS) -> Scene:
        """The scene of opened views, turned into its frame."""
        scene = Scene(tuple(views), crs, self.bounds, self.heights)
        return scene if self.up is None else _rotated(scene, rotation_to_axes(self.up, self.north))


@dataclass(frozen=True)
class _OpenedView:
    """An opened image and its camera, before the CRS of the scene is known."""

    entry: ResolvedEntry
    image: RasterImage
    camera: OpenedCamera

    @property
    def centre(self) -> tuple[float, float] | None:
        """Longitude and latitude of the centre, see `OpenedCamera`."""
        top, left, rows, cols = held_window(self.image)
        # The centre of an image whose middle is that of the stored part.
        return self.camera.centre((2 * top + rows, 2 * left + cols))

    @property
    def image_rpc(self) -> ImageRpc | None:
        """The image with its RPC; None where the camera is another one."""
        if not isinstance(self.camera, RpcSource):
            return None
        rpc = self.camera.rpc.moved(*(self.camera.shift or (0.0, 0.0)))
        acquisition = self.entry.acquisition.completed_by(self.image.acquisition)
        return ImageRpc(self.entry.path, self.image.shape, acquisition, rpc)

    def view(self, crs: CRS) -> View:
        """The view in the frame of the scene."""
        entry = self.entry
        acquisition = entry.acquisition.completed_by(self.image.acquisition)
        sensor = self.camera.sensor(crs)
        image = self._masked_image(sensor, crs)
        return View(entry.name, entry.path, image, sensor, self.camera.files, acquisition)

    def _masked_image(self, sensor: SensorModel, crs: CRS) -> RasterImage:
        """The image with the masks of its entry."""
        if not self.entry.masks:
            return self.image
        mean_height = self.camera.rpc.height_off if isinstance(self.camera, RpcSource) else None
        ground_view = GroundView(sensor, crs, self.image.shape, mean_height)
        mask = open_masks(self.entry.masks, self.entry.path, ground_view, self.entry.name)
        return replace(self.image, mask=mask, sources=(*self.image.sources, *mask.files))


def _inputs_of_scene(inputs: Sequence[Path], crs: CRS | None, refused: list[RefusedView] | None = None) -> _SceneInput:
    paths = [Path(path) for path in inputs]
    scene_files = [path for path in paths if path.suffix.lower() in SCENE_SUFFIXES]
    if scene_files and len(paths) > 1:
        raise InputError(f"{scene_files[0]} is a scene file and stands alone. Give it alone, or images only.")
    if scene_files:
        scene_input = _from_scene_file(scene_files[0], crs, refused)
    else:
        refused_products: list[RefusedProduct] | None = None if refused is None else []
        scene_input = _SceneInput(entries_of(paths, refused_products), Path(), crs)
        if refused is not None:
            refused += [RefusedView(each.path.stem, each.path, each.reason) for each in refused_products or ()]
    if scene_input.crs is not None and not is_local(scene_input.crs):
        scene_input = replace(scene_input, crs=checked_crs(scene_input.crs))
    _check_distinct([entry.path for entry in scene_input.entries])
    return scene_input


def _open_view(entry: ResolvedEntry, folder: Path) -> _OpenedView:
    """A view of which only the header and the camera have been read."""
    return _OpenedView(entry, open_header(entry.path, entry.colour_image), entry.camera.read(folder, entry.path))


def _open_checked_view(entry: ResolvedEntry, folder: Path) -> _OpenedView:
    """A view whose pixels have been checked."""
    image = _checked(open_header(entry.path, entry.colour_image))
    return _OpenedView(entry, image, entry.camera.read(folder, entry.path))


def _masked_view(opened_view: _OpenedView, crs: CRS) -> View:
    """The view of an image that was checked without its mask."""
    view = opened_view.view(crs)
    if opened_view.entry.masks:
        assert isinstance(view.image, RasterImage), "it was opened here"
        check_content(view.image)
    return view


def _checked(image: RasterImage) -> RasterImage:
    """The image after the checks of its pixels, without a plateau at its border."""
    check_last_block(image)
    check_grey_values(image)
    check_content(image)
    return with_plateau(image)


def _with_checked_image(view: View) -> View:
    """See `_checked`."""
    assert isinstance(view.image, RasterImage), "it was opened here"
    return replace(view, image=_checked(view.image))


def _from_scene_file(path: Path, crs: CRS | None, refused: list[RefusedView] | None) -> _SceneInput:
    scene_file = read_scene_file(path, refused)
    frame = None if scene_file.frame is None else _frame_crs(scene_file.frame, path)
    if frame is not None and is_local(frame) and crs is not None:
        raise ConfigError(f"{path} has a local frame, which --crs cannot place on the Earth. Leave --crs out.")
    if scene_file.area is not None and crs is not None and crs != frame:
        raise ConfigError(f"{path} gives area.bounds in another CRS than --crs. Leave --crs out, or remove the area.")
    named = None if scene_file.frame is None else scene_file.frame.crs
    entries = tuple(
        ResolvedEntry(
            view.name,
            path.parent / view.image,
            view.camera.with_default_crs(named),
            Acquisition(view.date),
            None if view.colours is None else view.colours.opened(path.parent, path.parent / view.image),
            tuple(entry.inside(path.parent) for entry in view.mask or ()),
        )
        for view in scene_file.views
    )
    bounds = None if scene_file.area is None else scene_file.area.bounds
    axes = (None, None) if scene_file.frame is None else (scene_file.frame.up, scene_file.frame.north)
    return _SceneInput(entries, path.parent, crs or frame, bounds, scene_file.heights, *axes)


def _rotated(scene: Scene, rotation: FloatArray) -> Scene:
    """The scene with its local frame rotated. rotation : (3, 3)."""
    views = []
    for view in scene.views:
        assert isinstance(view.sensor, FrameModel), "other cameras know their place on the Earth"
        views.append(replace(view, sensor=view.sensor.turned(rotation)))
    return replace(scene, views=tuple(views))


def _frame_crs(frame: Frame, path: Path) -> CRS:
    if frame.local:
        return local_frame()
    try:
        return checked_crs(CRS.from_user_input(frame.crs))
    except CRSError as error:
        raise InputError(f"{path}: frame.crs {quoted(frame.crs)} is no CRS. Write it as EPSG:n.") from error
    except ConfigError as error:
        raise ConfigError(f"{path}: frame.crs: {error}") from error


def _frame_of(opened: Sequence[_OpenedView], crs: CRS | None) -> CRS:
    """The CRS that is given, where it fits the place of the images; without one the UTM zone of their mean centre."""
    if crs is None:
        return utm_zone(*_mean_centre(opened))
    if all(each.centre is not None for each in opened):
        check_fits(crs, *_mean_centre(opened))
    return crs


def _mean_centre(opened: Sequence[_OpenedView]) -> tuple[float, float]:
    """Mean longitude and latitude of the images' centres, degrees. The date line is no gap between longitudes."""
    centres = []
    for each in opened:
        centre = each.centre
        if centre is None:
            raise InputError(
                f"The camera of {each.image.path} does not place its centre on the Earth. Check it, or give --crs."
            )
        centres.append(centre)
    first = centres[0][0]
    lon = first + sum((lon - first + 180.0) % 360.0 - 180.0 for lon, _ in centres) / len(centres)
    return lon, sum(lat for _, lat in centres) / len(centres)


def _check_distinct(paths: Sequence[Path]) -> None:
    known_paths: set[Path] = set()
    for path in paths:
        if path.resolve() in known_paths:
            raise InputError(f"{path} is given twice. Each image counts once; remove one.")
        known_paths.add(path.resolve())


def _with_shared_rpcs(opened: Sequence[_OpenedView]) -> list[tuple[_OpenedView, _OpenedView]]:
    """The pairs of views that have the identical RPC, see `shared_rpcs`."""
    by_path = {each.entry.path: each for each in opened}
    shared = shared_rpcs(rpc for each in opened if (rpc := each.image_rpc) is not None)
    return [(by_path[one.path], by_path[other.path]) for one, other in shared]


def _camera(value: Any, path: Path, where: str) -> Any:
    """The camera entry as the class of its kind. Anything but a mapping is returned, for the model to refuse."""
    if not isinstance(value, dict):
        return value
    kind = value.get("kind")
    if not isinstance(kind, str) or kind not in CAMERA_KINDS:
        raise InputError(f"{path}: {where}.kind is {kind!r}. Allowed: {', '.join(CAMERA_KINDS)}.")
    return validate_document(CAMERA_KINDS[kind], value, path, where)
