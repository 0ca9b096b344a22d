from __future__ import annotations

import datetime
import re
import shutil
import tarfile
import warnings
from dataclasses import replace

import numpy as np
import pytest
from affine import Affine

from made_up_deliveries import (
    CLOUD,
    FIRST_TIME,
    OFF_NADIR,
    SUN_AZIMUTH,
    SUN_ELEVATION,
    VIEW_AZIMUTH,
    VIEW_ELEVATION,
    dimap_delivery,
    gaofen_delivery,
    geoeye_delivery,
    maxar_delivery,
    nitf_delivery,
    planet_delivery,
    shots,
    stac_delivery,
    write_single,
    zipped,
)
from rpc_fixtures import write_image
from zlocus.core.errors import InputError, ZlocusWarning
from zlocus.core.scene import Acquisition, SunDirection
from zlocus.io.deliveries.delivery import describe, is_delivery, open_delivery
from zlocus.io.resolved_entry import entries_of
from zlocus.io.scene_file import open_scene

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
NAMESPACE = "http://xsd.digitalglobe.com/xsd/dm"
# Vendor: how its delivery is written, satellite in the names of views, and whether it has all kinds of metadata.
VENDORS = {
    "dimap": (dimap_delivery, "PHR1A"),
    "dimap of one tile": (lambda root, taken: dimap_delivery(root, taken, None), "PHR1A"),
    "maxar": (maxar_delivery, "WV03"),
    "maxar isd": (lambda root, taken: maxar_delivery(root, taken, isd=""), "WV03"),
    "maxar isd with a namespace": (lambda root, taken: maxar_delivery(root, taken, isd=NAMESPACE), "WV03"),
    "geoeye": (geoeye_delivery, "GeoEye-1"),
    "planet": (planet_delivery, "SSC2"),
    "gaofen": (gaofen_delivery, "GF2-PMS1"),
    "stac": (stac_delivery, "WV03"),
}


@pytest.fixture(scope="module")
def taken(images):
    return shots({name: images("sine").paths[name] for name in ("nadir", "fore")})


@pytest.fixture(scope="module")
def made(taken, tmp_path_factory):
    """A delivery of each vendor, made once: `made(vendor)`."""
    known = {}

    def of(vendor):
        if vendor not in known:
            known[vendor] = VENDORS[vendor][0](tmp_path_factory.mktemp("vendor") / "delivery", taken)
        return known[vendor]

    return of


def pixels(view):
    """The pixels of an image, those under its mask included."""
    image = replace(view.image, mask=None)
    return image.read(0, 0, *image.shape).pixels


@pytest.mark.parametrize("vendor", VENDORS)
def test_a_delivery_gives_the_pixels_and_cameras_of_single_files(made, taken, tmp_path, vendor):
    scene = open_scene([made(vendor)])
    single = open_scene([write_single(tmp_path, shot) for shot in taken])
    satellite = VENDORS[vendor][1]
    assert [view.name for view in scene.views] == [f"{satellite}_{shot.time:%Y%m%dT%H%M%S}" for shot in taken]
    for view, other, shot in zip(scene.views, single.views, taken, strict=True):
        assert np.array_equal(pixels(view), shot.grey)
        assert np.array_equal(pixels(view), pixels(other))
        # The offsets of DIMAP are one pixel larger in the file, and may lose their last digit.
        np.testing.assert_allclose(view.sensor.rpc.matrix, other.sensor.rpc.matrix, rtol=1e-14)
        assert view.sensor.rpc.line_off == pytest.approx(other.sensor.rpc.line_off, abs=1e-9)


@pytest.mark.parametrize("vendor", VENDORS)
def test_what_vendors_say_of_the_exposure(made, taken, vendor):
    for view, shot in zip(open_scene([made(vendor)]).views, taken, strict=True):
        said = view.acquisition
        assert (said.time, said.date) == (shot.time, FIRST_TIME.date())
        assert said.sun_direction == SunDirection(SUN_AZIMUTH, pytest.approx(SUN_ELEVATION))
        assert said.view_azimuth_deg == pytest.approx(VIEW_AZIMUTH)
        assert said.cloud_cover == CLOUD
        if vendor not in ("gaofen", "geoeye"):
            assert said.off_nadir_deg == OFF_NADIR
        if vendor != "planet":
            assert said.incidence_deg == pytest.approx(90 - VIEW_ELEVATION)


def test_an_altitude_that_is_called_a_zenith_angle_is_noticed(taken, tmp_path):
    """Some products of this vendor do so. Here the sun stood 11 degrees higher than half-way, so both differ."""
    for view in open_scene([gaofen_delivery(tmp_path / "d", taken, zenith=SUN_ELEVATION)]).views:
        assert view.sun_direction == SunDirection(SUN_AZIMUTH, pytest.approx(SUN_ELEVATION))


def smoothed(bands, axis):
    """A band after interpolation at four places of each pixel, 3/8 and 1/8 of a pixel from its centre to both sides,
    of which the two inner ones are averaged."""
    before, after = (np.roll(bands, shift, axis) for shift in (1, -1))
    return 0.875 * bands + 0.0625 * (before + after)


@pytest.mark.parametrize("vendor", VENDORS)
def test_colours_are_those_of_the_multispectral_image(made, taken, vendor):
    """The centres of the larger pixels lie between the pixels 1 and 2 of each four."""
    for view, shot in zip(open_scene([made(vendor)]).views, taken, strict=True):
        colours = view.image.colours(0, 0, *view.image.shape)
        found = np.mean([colours[:, i::4, j::4] for i in (1, 2) for j in (1, 2)], axis=0)
        expected = smoothed(smoothed(shot.bands("RGB").astype(float), 1), 2)
        inner = (slice(None), slice(1, -1), slice(1, -1))
        # Interpolation works in 32nds of a pixel.
        np.testing.assert_allclose(found[inner], expected[inner], atol=0.03 * expected.std())
        part = view.image.colours(9, 21, 30, 40)
        np.testing.assert_allclose(part, colours[:, 9:39, 21:61], atol=0.03 * expected.std())


@pytest.mark.parametrize("vendor", VENDORS)
def test_masks_of_clouds_are_obeyed_and_those_of_snow_are_not(made, taken, vendor):
    for view, shot in zip(open_scene([made(vendor)]).views, taken, strict=True):
        valid = view.image.read(0, 0, *view.image.shape).valid
        has_mask = vendor.startswith(("dimap", "planet"))
        assert np.array_equal(valid, ~shot.is_cloudy if has_mask else np.ones_like(valid))
        assert bool([path for path in view.files if "MSK" in path.name or "udm" in path.name]) == has_mask


@pytest.mark.parametrize(
    ("vendor", "which", "said"),
    [
        (
            "dimap",
            "CLD_*_P_*-001_MSK.GML",
            r"delivery lacks 2 masks that belong to its images: CLD_PHR1A_P_.*GML, CLD_",
        ),
        (
            "dimap",
            "QTE_*_P_*nadir-001_MSK.GML",
            r"lacks a mask that belongs to its images: QTE_PHR1A_P_.*nadir.*\.GML\.",
        ),
        ("dimap", "SNW_*.GML", None),
        ("dimap", "CLD_*_MS_*.GML", None),
        (
            "planet",
            "*nadir*panchromatic_udm2.tif",
            r"lacks a mask that .*: .*nadir_basic_panchromatic_udm2\.tif\. Clouds",
        ),
        ("planet", "*udm2.tif", None),
    ],
)
def test_masks_that_are_obeyed_and_missing_are_named(made, tmp_path, vendor, which, said):
    delivery = shutil.copytree(made(vendor), tmp_path / "delivery")
    for path in delivery.rglob(which):
        path.unlink()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ZlocusWarning)
        entries_of([delivery])
    sentences = [str(each.message) for each in caught]
    assert len(sentences) == (said is not None)
    assert all(re.search(said, sentence) for sentence in sentences)


def test_nitf_files_of_a_folder(taken, tmp_path):
    scene = open_scene([nitf_delivery(tmp_path / "n", taken)])
    assert [view.name for view in scene.views] == [f"{shot.time:%Y%m%dT%H%M%S}" for shot in taken]
    for view, shot in zip(sorted(scene.views, key=lambda view: view.acquisition.time), taken, strict=True):
        assert np.array_equal(pixels(view), shot.grey)
        assert view.acquisition.time == shot.time


@pytest.mark.parametrize("vendor", ["dimap", "maxar", "planet", "gaofen"])
@pytest.mark.parametrize("kind", ["zip", "tar", "tgz"])
def test_archives_are_read_in_place(made, taken, tmp_path, vendor, kind):
    folder, archive = made(vendor), tmp_path / f"d.{kind}"
    if kind == "zip":
        zipped(folder, archive)
    else:
        with tarfile.open(archive, "w" if kind == "tar" else "w:gz") as file:
            file.add(folder, "delivery")
    scene = open_scene([archive])
    assert [view.name for view in scene.views] == [view.name for view in open_scene([folder]).views]
    for view, shot in zip(scene.views, taken, strict=True):
        assert np.array_equal(pixels(view), shot.grey)
        assert view.image.has_colours
    assert sorted(path.name for path in tmp_path.iterdir()) == [archive.name]


def test_a_folder_in_an_archive_and_one_index_are_inputs_too(made, taken, tmp_path):
    archive = zipped(made("dimap"), tmp_path / "d.zip")
    inside = [f"/vsizip/{archive}/delivery/PROD_{shot.name}" for shot in taken]
    assert len(open_scene([*map(type(archive), inside)]).views) == 2
    indices = sorted(made("dimap").rglob("DIM_*_P_*.XML"))
    names = [view.name for view in open_scene(indices).views]
    assert names == [f"PHR1A_{shot.time:%Y%m%dT%H%M%S}" for shot in taken[::-1]]
    scene = open_scene([indices[0], sorted(made("maxar").rglob("*.TIL"))[0]])
    assert np.array_equal(pixels(scene.views[1]), taken[0].grey)


def test_a_table_of_dates_completes_and_corrects(taken, tmp_path):
    for shot in taken:
        write_single(tmp_path, shot)
    (tmp_path / "dates.csv").write_text(
        "image,acquired_utc_yyyymmddhhmmss,sun_elevation_deg,sun_azimuth_deg\n"
        "nadir.tif,20150607080910,50.8,150.3\nfore.tif,20150607081010,,\n"
    )
    fore, nadir = sorted(open_scene([tmp_path]).views, key=lambda view: view.path.name)
    assert (nadir.name, fore.name) == ("20150607T080910", "20150607T081010")
    assert nadir.sun_direction == SunDirection(150.3, 50.8)
    assert fore.sun_direction is None


@pytest.mark.parametrize("name", ["nadir", "NADIR.TIF", "nadir.ntf", "folder/nadir.tif"])
def test_a_table_names_images_with_or_without_suffix(taken, tmp_path, name):
    write_single(tmp_path, taken[0])
    (tmp_path / "dates.csv").write_text(f"image,date,cloud_cover,off_nadir_deg\n{name},2015-06-07,0.25,-12\n")
    (view,) = open_delivery(tmp_path).views
    assert view.image.acquisition == Acquisition(date=datetime.date(2015, 6, 7), cloud_cover=0.25, off_nadir_deg=12.0)


def test_a_table_of_panchromatic_images_leaves_them_their_colours(made, tmp_path):
    delivery = shutil.copytree(made("maxar"), tmp_path / "delivery")
    indices = sorted(path.name for path in delivery.rglob("*P1BS*.TIL"))
    rows = [f"{name},2015-06-0{day},08:09:10" for day, name in enumerate(indices, 1)]
    (delivery / "dates.csv").write_text("\n".join(["image,date,time", *rows, ""]))
    views = open_delivery(delivery).views
    assert [view.name for view in views] == ["WV03_20150601T080910", "WV03_20150602T080910"]
    assert all(view.partner is not None for view in views)


def test_what_is_left_out_is_named(taken, tmp_path):
    for shot in taken:
        write_single(tmp_path, shot)
    for number in range(5):
        write_image(tmp_path / f"dem_{number}.tif", taken[0].grey)
    (tmp_path / "order.pdf").write_bytes(b"%PDF")
    assert describe(open_delivery(tmp_path)) == (
        f"{tmp_path} holds 2 views. Left out: dem_0.tif, dem_1.tif, dem_2.tif and 2 more (has no RPC, in its tags or "
        "beside it)."
    )
    with pytest.warns(ZlocusWarning, match="Left out: dem_0.tif"):
        open_scene([tmp_path])


def test_a_view_whose_time_alone_is_not_known_has_the_name_of_its_product(taken, tmp_path):
    for shot in taken:
        write_single(tmp_path, shot)
    (tmp_path / "dates.csv").write_text("image,date\nnadir.tif,2014-10-05\nfore.tif,2014-10-05T16:01:38Z\n")
    assert {view.name for view in open_delivery(tmp_path).views} == {"nadir", "20141005T160138"}


def test_of_two_orders_each_image_takes_the_colours_of_its_own(made, taken, tmp_path):
    """Two satellites that took images at the same times: the cameras of both colours would fit."""
    for vendor in ("maxar", "dimap"):
        shutil.copytree(made(vendor), tmp_path / vendor)
    views = open_delivery(tmp_path).views
    assert len(views) == 2 * len(taken)
    for view in views:
        assert view.partner.image.acquisition.satellite == view.image.acquisition.satellite


def test_results_of_zlocus_are_no_part_of_a_delivery(taken, tmp_path):
    for shot in taken:
        write_single(tmp_path, shot)
    (tmp_path / "surface").mkdir()
    write_image(tmp_path / "surface" / "dsm.tif", taken[0].grey)
    (tmp_path / "surface" / "events.jsonl").touch()
    delivery = open_delivery(tmp_path)
    assert len(delivery.views) == 2
    assert not delivery.set_aside


def test_maps_in_a_delivery_are_no_doubt_and_images_without_a_camera_are(taken, tmp_path):
    root = planet_delivery(tmp_path / "d", taken)
    place = {"crs": "EPSG:32631", "transform": Affine(1.0, 0.0, 5e5, 0.0, -1.0, 5e6)}
    write_image(root / "map.tif", taken[0].grey, **place)
    delivery = open_delivery(root)
    assert not delivery.is_doubtful
    assert "2 views, 2 of them with the colours" in describe(delivery)
    assert describe(delivery).endswith("Left out: map.tif (is a map or a product of one, and has no RPC).")
    next(root.glob("*nadir_basic_panchromatic_dn.tif")).rename(root / "pan.tif")
    delivery = open_delivery(root)
    assert delivery.is_doubtful
    assert "pan.tif (has no RPC" in describe(delivery)
    assert "nadir_basic_panchromatic_udm2.tif (is the mask of an image that is missing" in describe(delivery)
    assert describe(delivery).endswith("of its pass and ground was found: SSC2_20141005T160138.")


def test_what_is_a_delivery(tmp_path, made):
    assert is_delivery(tmp_path)
    assert is_delivery(tmp_path / "a.zip")
    assert not is_delivery(tmp_path / "a.tif")


def test_a_folder_without_images_says_so(tmp_path):
    (tmp_path / "readme.txt").write_text("nothing")
    with pytest.raises(InputError, match=r"holds no image with a camera\. Give the folder that the vendor delivered"):
        open_delivery(tmp_path)
