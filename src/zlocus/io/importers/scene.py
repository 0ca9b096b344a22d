"""Write a `scene.yaml` from the cameras of another program, after finding their images and checking their sizes."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from zlocus.core.errors import ConfigError, InputError, OutputError
from zlocus.core.quoting import quoted
from zlocus.core.requests import ImportRequest
from zlocus.io.cameras.frame_camera import FrameCamera
from zlocus.io.importers.base import ImportedCameras, ImportedExposure
from zlocus.io.importers.earth import parsed_crs, scene_file_crs
from zlocus.io.importers.place import placed_cameras
from zlocus.io.importers.registry import IMPORTERS
from zlocus.io.open_raster import open_raster
from zlocus.io.safe_text import EXPORT_AGAIN
from zlocus.io.scene_file import SceneFile, ViewEntry, write_scene_file
from zlocus.io.schema import validate_document
from zlocus.sensors.frame import as_row, as_rows

FOLDERS = ("", "images", "../images", "../../images", "../../../images", "undistorted/images", "../visualize")
SUFFIXES = (".tif", ".tiff", ".jpg", ".jpeg", ".png", ".jp2", ".vrt", ".img")
MIN_IMAGES = 2


def import_scene(request: ImportRequest) -> SceneFile:
    """Import the cameras that the request names: write the scene file and return it.

    Raises
    ------
    InputError
        Cameras or images are missing, damaged or do not fit together.
    ConfigError
        The format is not known, or an option does not apply to it.
    OutputError
        The scene file exists already, or cannot be written.
    """
    if request.kind not in IMPORTERS:
        raise ConfigError(f"{request.kind} is no format that can be imported. Choose from {', '.join(IMPORTERS)}.")
    importer = IMPORTERS[request.kind]
    for name in request.given():
        if name not in importer.options:
            raise ConfigError(f"--{name} says nothing to an import of {request.kind}. Leave it out.")
    if request.out.exists() and not request.overwrite:
        raise OutputError(f"{request.out} exists already. Choose another name with -o, or add --overwrite.")
    cameras = importer.read(request)
    if "offset" in importer.options:
        cameras = placed_cameras(cameras, request)
    scene = scene_of(cameras, request)
    write_scene_file(request.out, scene)
    return scene


def scene_of(cameras: ImportedCameras, request: ImportRequest) -> SceneFile:
    """The scene file of imported cameras, with paths of images relative to it.

    Raises
    ------
    InputError
        There are fewer than two images, an image is missing or listed twice, or its size is not that of its camera.
    """
    exposures = cameras.exposures
    if len(exposures) < MIN_IMAGES:
        raise InputError(
            f"{cameras.path} holds {len(exposures)} oriented images, and a surface needs {MIN_IMAGES} or more. "
            f"{EXPORT_AGAIN}"
        )
    image, times = Counter(exposure.image for exposure in exposures).most_common(1)[0]
    if times > 1:
        raise InputError(f"{cameras.path}: the image {quoted(image)} is there twice. {EXPORT_AGAIN}")
    paths = _image_paths(exposures, cameras.path, request.images)
    folder = request.out.absolute().parent.resolve()
    crs = None if cameras.crs is None else scene_file_crs(parsed_crs(cameras.crs))
    earth = {"earth": "flat"} if crs is not None and cameras.flat else {}
    views = [
        ViewEntry(name=name, image=_relative(path, folder), camera=_camera(exposure, path, cameras.path, earth))
        for exposure, path, name in zip(exposures, paths, _names(exposures), strict=True)
    ]
    frame: dict[str, Any] = {"local": True} if crs is None else {"crs": crs}
    if request.up is not None:
        frame["up"] = request.up
    if request.north is not None:
        frame["north"] = request.north
    return validate_document(SceneFile, {"schema": 1, "frame": frame, "views": views}, cameras.path)


def _camera(exposure: ImportedExposure, image: Path, path: Path, earth: dict[str, Any]) -> FrameCamera:
    """The camera entry of an exposure, after checking that the image has the size of its camera."""
    with open_raster(image) as source:
        size = (source.width, source.height)
    if exposure.size not in (None, size):
        wide, high = exposure.size or size
        raise InputError(
            f"{image} has {size[0]} x {size[1]} pixels, and its camera in {path} {wide} x {high}. Give the folder of "
            "the images that were oriented with --images."
        )
    centre = {"principal_point": [(size[0] - 1) / 2, (size[1] - 1) / 2]}
    pose = {"centre": as_row(exposure.centre), "rotation": as_rows(exposure.rotation)}
    entry = {"kind": "frame", **centre, **exposure.interior, **pose, **earth}
    return validate_document(FrameCamera, entry, path, f"camera of {quoted(exposure.image)}")


def _image_paths(exposures: Sequence[ImportedExposure], path: Path, given: Path | None) -> list[Path]:
    """The paths of the images: in the given folder, else in or near the folder of the cameras."""
    start = path if path.is_dir() else path.parent
    folders = [given] if given is not None else [start / name for name in FOLDERS]
    for folder in folders:
        if _find_image(exposures[0].image, folder) is not None:
            paths_by_name = {exposure.image: _find_image(exposure.image, folder) for exposure in exposures}
            missing = [name for name, image in paths_by_name.items() if image is None]
            if missing:
                raise InputError(
                    f"{folder} lacks {len(missing)} of {len(exposures)} images of {path}, first {quoted(missing[0])}. "
                    "Add them, or give another folder with --images."
                )
            return [image for image in paths_by_name.values() if image is not None]
    where = str(given) if given is not None else f"{start} and images beside it"
    raise InputError(
        f"The image {quoted(exposures[0].image)} of {path} is not in {where}. Give the folder with --images."
    )


def _find_image(name: str, folder: Path) -> Path | None:
    """The path of an image in a folder; None where there is none.

    The name is tried with and without its folders, and with the suffixes of images.
    """
    if not name or "\0" in name or len(os.fsencode(name)) > 1000:
        return None
    plain = name.replace("\\", "/")
    try:
        for candidate in (folder / plain, folder / Path(plain).name):
            if candidate.is_file():
                return candidate
            for suffix in (s for small in SUFFIXES for s in (small, small.upper())):
                with_suffix = candidate.with_name(candidate.name + suffix)
                if with_suffix.is_file():
                    return with_suffix
    except (OSError, ValueError):
        return None
    return None


def _names(exposures: Sequence[ImportedExposure]) -> list[str]:
    """A name for each view: that of the image without its suffix, or in full where two would be equal."""
    stems = [Path(exposure.image).stem for exposure in exposures]
    times = Counter(stems)
    return [e.image if times[stem] > 1 else stem for e, stem in zip(exposures, stems, strict=True)]


def _relative(path: Path, folder: Path) -> str:
    """A path relative to the folder of the scene file, as it is written there.

    Links on the way to the image stay as they are, so that a folder with a link to its images can be moved. They are
    followed where the steps up from the folder (`..`) would otherwise lead elsewhere.
    """
    found = [Path(os.path.relpath(each, folder)) for each in (path.absolute(), path.resolve())]
    is_same = os.path.exists(folder / found[0]) and os.path.samefile(folder / found[0], path)
    return found[0 if is_same else 1].as_posix()
