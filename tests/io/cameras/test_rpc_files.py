"""RPC readers: in every format the centre of the first pixel becomes (0, 0)."""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest
import rasterio

from rpc_fixtures import dimap_dim, dimap_rpc, rpb, rpc_txt, satellite_rpc, write_image
from zlocus.core.errors import InputError
from zlocus.io.cameras.rpc import find_sidecar, read_rpc
from zlocus.sensors.rpc import RpcCoefficients

RPC = satellite_rpc()
# GDAL keeps the tag as text of 15 digits; offsets of 20 000 px then differ by 1e-11 px.
RELATIVE = 1e-14
PIXELS = np.arange(64, dtype=np.uint16).reshape(8, 8)


def assert_same(one: RpcCoefficients, other: RpcCoefficients) -> None:
    for a, b in zip(astuple(one), astuple(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=RELATIVE, atol=1e-18)


def moved_off(rpc: RpcCoefficients) -> RpcCoefficients:
    """Another RPC, for the file that must not be chosen."""
    return rpc.moved(column=1000.0, row=1000.0)


@pytest.fixture
def image(tmp_path):
    return write_image(tmp_path / "IMG_PHR1A_P_001_R1C1.TIF", PIXELS)


def test_geotiff_tag_counts_from_the_centre_of_the_first_pixel(tmp_path):
    path = write_image(tmp_path / "a.tif", PIXELS, RPC)
    assert_same(read_rpc(path), RPC)


def test_rpc_txt_counts_from_the_centre_of_the_first_pixel(image):
    image.with_name(image.stem + "_RPC.TXT").write_text(rpc_txt(RPC))
    assert_same(read_rpc(image), RPC)


def test_rpb_counts_from_the_centre_of_the_first_pixel(image):
    image.with_suffix(".RPB").write_text(rpb(RPC))
    assert_same(read_rpc(image), RPC)


def test_dimap_counts_from_one(image):
    image.with_name("RPC_PHR1A_P_001.XML").write_text(dimap_rpc(RPC))
    assert "<SAMP_OFF>20101.75<" in image.with_name("RPC_PHR1A_P_001.XML").read_text()
    assert_same(read_rpc(image), RPC)


@pytest.mark.parametrize("first_pixel", [1.0, 0.5, 0.0])
def test_dimap_3_says_how_it_counts(image, first_pixel: float):
    path = image.with_name("RPC_PHR1A_P_001.XML")
    path.write_text(dimap_rpc(RPC, version=3, first_pixel=first_pixel))
    assert_same(read_rpc(image), RPC)


@pytest.mark.parametrize("text", [dimap_rpc(RPC), dimap_rpc(RPC, version=3)])
def test_gdal_reads_the_same_from_dimap(image, text: str):
    image.with_name("RPC_PHR1A_P_001.XML").write_text(text)
    image.with_name("DIM_PHR1A_P_001.XML").write_text(dimap_dim({image.name: (1, 1)}, (8, 8)))
    with rasterio.open(image) as source:
        tags = source.tags(ns="RPC")
    ours = read_rpc(image)
    assert float(tags["SAMP_OFF"]) == pytest.approx(ours.samp_off, abs=1e-9)
    assert float(tags["LINE_OFF"]) == pytest.approx(ours.line_off, abs=1e-9)
    np.testing.assert_allclose([float(x) for x in tags["LINE_NUM_COEFF"].split()], ours.line_num, rtol=RELATIVE)
    np.testing.assert_allclose([float(x) for x in tags["SAMP_DEN_COEFF"].split()], ours.samp_den, rtol=RELATIVE)


def test_tile_of_a_dimap_product_starts_where_its_dim_file_says(tmp_path):
    image = write_image(tmp_path / "IMG_PHR1A_P_001_R2C3.TIF", PIXELS)
    (tmp_path / "RPC_PHR1A_P_001.XML").write_text(dimap_rpc(RPC))
    with pytest.raises(InputError, match=r"DIM_PHR1A_P_001\.XML is missing"):
        read_rpc(image)
    (tmp_path / "DIM_PHR1A_P_001.XML").write_text(dimap_dim({"other.tif": (1, 1)}, (100, 200)))
    with pytest.raises(InputError, match="does not say where"):
        read_rpc(image)
    (tmp_path / "DIM_PHR1A_P_001.XML").write_text(dimap_dim({image.name: (2, 3)}, (100, 200)))
    assert_same(read_rpc(image), RPC.moved(column=-400, row=-100))


def test_dim_file_leads_to_its_rpc_file(tmp_path):
    image = write_image(tmp_path / "crop.tif", PIXELS)
    dim = tmp_path / "DIM_X.XML"
    dim.write_text(dimap_dim({"crop.tif": (1, 1)}, (8, 8), "RPC_Y.XML"))
    with pytest.raises(InputError, match=r"DIM_X\.XML names RPC_Y\.XML, which is missing"):
        read_rpc(image)
    (tmp_path / "RPC_X.XML").write_text(dimap_rpc(moved_off(RPC)))
    (tmp_path / "RPC_Y.XML").write_text(dimap_rpc(RPC))
    assert find_sidecar(image) == dim
    assert_same(read_rpc(image), RPC)
    assert_same(read_rpc(image, dim), RPC)


def test_a_named_file_wins_then_rpb_then_txt_then_dimap_then_tag(tmp_path):
    path = write_image(tmp_path / "IMG_a.tif", PIXELS, RPC.moved(1, 0))
    assert read_rpc(path).samp_off == pytest.approx(RPC.samp_off + 1)
    files = [tmp_path / name for name in ("RPC_a.XML", "IMG_a_RPC.TXT", "IMG_a.RPB", "named.txt")]
    writers = (dimap_rpc, rpc_txt, rpb, rpc_txt)
    for step, (file, text) in enumerate(zip(files, writers, strict=True), 2):
        file.write_text(text(RPC.moved(step, 0)))
        named = file if file.name == "named.txt" else None
        assert read_rpc(path, named).samp_off == pytest.approx(RPC.samp_off + step), file.name


def test_another_image_lends_its_tag(tmp_path):
    lender = write_image(tmp_path / "full.tif", PIXELS, RPC)
    assert_same(read_rpc(write_image(tmp_path / "a.tif", PIXELS), lender), RPC)


def test_without_camera(image):
    with pytest.raises(InputError, match=r"R1C1\.TIF has no camera: no RPC tag.*scene\.yaml"):
        read_rpc(image)
    with pytest.raises(InputError, match="There is no camera file"):
        read_rpc(image, image.with_name("none.txt"))


BROKEN = {
    "missing": (lambda text: text.replace("LAT_SCALE", "LAT_SKALE"), "has no LAT_SCALE"),
    "nan": (lambda text: text.replace("HEIGHT_OFF: +450", "HEIGHT_OFF: nan"), "HEIGHT_OFF of the RPC holds 'nan'"),
    "word": (lambda text: text.replace("LINE_OFF: +19500.25", "LINE_OFF: many"), "LINE_OFF of the RPC holds 'many'"),
    "short": (
        lambda text: text.replace("SAMP_DEN_COEFF_20:", "X:"),
        "SAMP_DEN_COEFF of the RPC has 19 numbers, not 20",
    ),
    "zero": (lambda text: text.replace("SAMP_SCALE: +20000", "SAMP_SCALE: 0"), "SAMP_SCALE of the RPC is 0"),
    "empty": (lambda _: "", "has no LINE_OFF"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_broken_rpc_names_file_and_field(image, fault: str):
    spoil, message = BROKEN[fault]
    assert spoil(rpc_txt(RPC)) != rpc_txt(RPC)
    image.with_name(image.stem + "_RPC.TXT").write_text(spoil(rpc_txt(RPC)))
    with pytest.raises(InputError, match=message) as caught:
        read_rpc(image)
    assert "R1C1_RPC.TXT" in str(caught.value)


def test_broken_tag_dimap_and_rpb(tmp_path, image):
    infinite = replace(RPC, line_num=(np.inf, *RPC.line_num[1:]))
    with pytest.raises(InputError, match=r"a\.tif: LINE_NUM_COEFF of the RPC holds 'inf'"):
        read_rpc(write_image(tmp_path / "a.tif", PIXELS, infinite))
    pole = replace(RPC, samp_den=(0.0, *RPC.samp_den[1:]))
    with pytest.raises(InputError, match="SAMP_DEN_COEFF_1 of the RPC is 0"):
        read_rpc(write_image(tmp_path / "b.tif", PIXELS, pole))

    xml = image.with_name("RPC_PHR1A_P_001.XML")
    for text, message in (
        (dimap_rpc(RPC).replace("Inverse_Model", "Other_Model"), "no Inverse_Model"),
        (dimap_rpc(RPC).replace("LINE_NUM_COEFF_7>", "X>"), "LINE_NUM_COEFF of the RPC has 19 numbers"),
        (dimap_rpc(RPC)[:500], "cannot be read as XML"),
    ):
        xml.write_text(text)
        with pytest.raises(InputError, match=message):
            read_rpc(image)

    image.with_suffix(".RPB").write_text(rpb(RPC).replace("RPC00B", "RPC00A"))
    with pytest.raises(InputError, match="RPC00A model, of another term order"):
        read_rpc(image)
