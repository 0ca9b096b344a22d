"""Deliveries that are damaged, contradict themselves, or want to do harm: each ends in one sentence."""

from __future__ import annotations

import datetime
import json
import re
import struct
import tarfile
import zipfile

import numpy as np
import pytest

from made_up_deliveries import (
    dimap_delivery,
    gaofen_delivery,
    maxar_delivery,
    planet_delivery,
    shots,
    stac_delivery,
    write_single,
    zipped,
)
from rpc_fixtures import write_image
from zlocus.core.errors import InputError, ZlocusWarning
from zlocus.io.archives import SMALL_BYTES
from zlocus.io.deliveries.delivery import describe, open_delivery
from zlocus.io.scene_file import open_scene, open_usable_views

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture(scope="module")
def taken(images):
    return shots({name: images("sine").paths[name] for name in ("nadir", "fore")})


def refused(path):
    """The sentence with which a delivery is refused."""
    with pytest.raises(InputError) as caught:
        open_delivery(path)
    sentence = str(caught.value)
    assert sentence.endswith(".")
    assert "\n" not in sentence
    return sentence


def one(root, pattern):
    return sorted(root.rglob(pattern))[0]


def changed(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def archive_with(path, name, content=b"x", **attributes):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        info = zipfile.ZipInfo(name)
        for key, value in attributes.items():
            setattr(info, key, value)
        file.writestr(info, content)
    return path


@pytest.mark.parametrize("name", ["../out.tif", "/etc/passwd", "a/../../b.tif", "C:/x.tif", "a\\b.tif", "a\nb.tif"])
def test_names_that_leave_an_archive(tmp_path, name):
    # `zipfile` mends some names as it writes them, but not as it reads them.
    archive_with(tmp_path / "d.zip", "N" * len(name))
    content = (tmp_path / "d.zip").read_bytes()
    (tmp_path / "d.zip").write_bytes(content.replace(b"N" * len(name), name.encode()))
    assert "leaves the archive" in refused(tmp_path / "d.zip")
    with tarfile.open(tmp_path / "d.tar", "w") as file:
        file.addfile(tarfile.TarInfo(name))
    assert "leaves the archive" in refused(tmp_path / "d.tar")


def test_links_in_archives(tmp_path):
    archive_with(tmp_path / "d.zip", "img.tif", b"/etc/passwd", external_attr=0o120777 << 16, create_system=3)
    assert "which is a link" in refused(tmp_path / "d.zip")
    for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE):
        with tarfile.open(tmp_path / "d.tar", "w") as file:
            info = tarfile.TarInfo("img.tif")
            info.type, info.linkname = kind, "/etc/passwd"
            file.addfile(info)
        assert "which is " in refused(tmp_path / "d.tar")


def test_bombs(tmp_path):
    """Zeros that are more than any image; nothing is unpacked to see that in a ZIP, and no more than the limit in a
    compressed TAR."""
    block = bytes(1 << 20)
    with zipfile.ZipFile(tmp_path / "d.zip", "w", zipfile.ZIP_DEFLATED) as file, file.open("a.tif", "w") as member:
        for _ in range((SMALL_BYTES >> 20) + 2):
            member.write(block)
    assert "as no image does" in refused(tmp_path / "d.zip")
    # Many members, each of them small enough, that share their bytes.
    archive_with(tmp_path / "s.zip", "a.tif", block)
    content = bytearray((tmp_path / "s.zip").read_bytes())
    at = content.index(b"PK\x01\x02")
    entry, end = content[at : content.index(b"PK\x05\x06")], content[content.index(b"PK\x05\x06") :]
    entries = b"".join(bytes(entry).replace(b"a.tif", b"%05d" % number) for number in range(100))
    struct.pack_into("<HHL", end, 8, 100, 100, len(entries))
    (tmp_path / "s.zip").write_bytes(bytes(content[:at]) + entries + bytes(end))
    assert "are those of another file" in refused(tmp_path / "s.zip")


def test_damaged_archives(tmp_path):
    (tmp_path / "d.zip").write_bytes(b"PK no archive")
    assert "cannot be read as an archive" in refused(tmp_path / "d.zip")
    (tmp_path / "d.tgz").write_bytes(b"\x1f\x8b\x08\x00" + bytes(40))
    assert "cannot be read as an archive" in refused(tmp_path / "d.tgz")
    assert "cannot be read: No such file or directory" in refused(tmp_path / "none.zip")
    with zipfile.ZipFile(tmp_path / "t.zip", "w") as file:
        file.writestr("a.tif", b"1")
        with pytest.warns(UserWarning, match="Duplicate name"):
            file.writestr("a.tif", b"2")
    assert "holds 'a.tif' twice" in refused(tmp_path / "t.zip")
    archive_with(tmp_path / "e.zip", "a.tif", b"1")
    content = bytearray((tmp_path / "e.zip").read_bytes())
    for signature, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(signature) + place] |= 1
    (tmp_path / "e.zip").write_bytes(content)
    assert "is encrypted" in refused(tmp_path / "e.zip")


def test_an_archive_in_an_archive_is_not_opened(taken, tmp_path):
    inner = zipped(dimap_delivery(tmp_path / "delivery", taken), tmp_path / "inner.zip")
    with zipfile.ZipFile(tmp_path / "d.zip", "w") as file:
        file.write(inner, "inner.zip")
    alone = f"{tmp_path / 'd.zip'} holds no image with a camera: inner.zip is an archive in it, which is not opened"
    assert refused(tmp_path / "d.zip").startswith(alone)
    # Beside an order it is a note.
    inner.rename(tmp_path / "delivery" / "inner.zip")
    (tmp_path / "delivery" / "other").symlink_to(tmp_path)
    delivery = open_delivery(tmp_path / "delivery")
    assert len(delivery.views) == 2
    assert not delivery.is_doubtful
    assert "inner.zip (is an archive in it" in describe(delivery)
    assert "other (is a link to a folder" in describe(delivery)


def test_an_archive_says_what_is_wrong_with_it(tmp_path):
    (tmp_path / "image.tif").write_bytes(bytes(range(256)) * 40)
    with zipfile.ZipFile(tmp_path / "good.zip", "w") as file:
        file.write(tmp_path / "image.tif", "image.tif")
    for name, mode in (("good.tar", "w"), ("good.tgz", "w:gz")):
        with tarfile.open(tmp_path / name, mode) as file:
            file.add(tmp_path / "image.tif", "image.tif")
    contents = {name: (tmp_path / f"good.{name}").read_bytes() for name in ("zip", "tar", "tgz")}
    for name, content, says in (
        ("a.zip", contents["tar"], "is a TAR archive by its content. Rename it, so that its name ends in .tar."),
        ("b.zip", contents["tgz"], "is a compressed TAR archive by its content. Rename it"),
        ("a.tar", contents["zip"], "is a ZIP archive by its content. Rename it, so that its name ends in .zip."),
        ("c.zip", contents["zip"][:5000], "is cut short: the list of its files"),
        ("c.tar", contents["tar"][:5000], "is cut short: it ends within one of its files"),
        ("c.tgz", contents["tgz"][:-40], "is cut short: it ends within one of its files"),
        ("d.zip", b"", "is empty: it has no bytes"),
    ):  # fmt: skip
        (tmp_path / name).write_bytes(content)
        assert f"{tmp_path / name} {says}" in refused(tmp_path / name)
    with zipfile.ZipFile(tmp_path / "e.zip", "w"):
        pass
    assert f"{tmp_path / 'e.zip'} is empty: it holds no files." in refused(tmp_path / "e.zip")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("../IMG.TIF", "does not lie below its folder"),
        ("/etc/passwd", "does not lie below its folder"),
        ("http://server/IMG.TIF", "does not lie below its folder"),
        ("/vsicurl/http://server/IMG.TIF", "does not lie below its folder"),
        ("IMG_none_R1C1.TIF", "which is missing"),
    ],
)
def test_tiles_elsewhere_or_missing(taken, tmp_path, name, says):
    root = dimap_delivery(tmp_path / "d", taken)
    index = one(root, "DIM_*_P_*.XML")
    changed(index, f'href="{one(index.parent, "IMG_*_R1C1.TIF").name}"', f'href="{name}"')
    assert says in refused(root)
    root = maxar_delivery(tmp_path / "m", taken)
    index = one(root, "*.TIL")
    changed(index, f'"{one(index.parent, "*R1C1*.TIF").name}"', f'"{name}"')
    assert says in refused(root)


def test_a_tile_that_is_a_link_out_of_the_delivery(taken, tmp_path):
    root = dimap_delivery(tmp_path / "d", taken)
    tile = one(root, "IMG_*_P_*_R1C1.TIF")
    tile.rename(tmp_path / "elsewhere.TIF")
    tile.symlink_to(tmp_path / "elsewhere.TIF")
    assert f"the file {tile.name!r}, which is a link that leaves its folder" in refused(root)


def test_a_tile_that_is_a_list_of_other_files(taken, tmp_path):
    root = dimap_delivery(tmp_path / "d", taken)
    one(root, "IMG_*_P_*_R1C1.TIF").write_text('<VRTDataset rasterXSize="100" rasterYSize="70"></VRTDataset>')
    assert "holds no pixels itself" in refused(root)


@pytest.mark.parametrize(
    ("write", "tile"), [(dimap_delivery, "IMG_*_P_*R2C1.TIF"), (maxar_delivery, "*P1BS_R2C1*.TIF")]
)
def test_a_truncated_tile_is_named(taken, tmp_path, write, tile):
    path = one(write(tmp_path / "d", taken), tile)
    path.write_bytes(path.read_bytes()[:8000])
    with pytest.raises(InputError, match=rf"{path.name} is truncated: it has 8000 bytes, and pixels of row \d+ on lie"):
        open_scene([tmp_path / "d"])


def test_entities_in_xml(taken, tmp_path):
    root = dimap_delivery(tmp_path / "d", taken)
    changed(
        one(root, "DIM_*_P_*.XML"), "<Dimap_Document>",
        '<!DOCTYPE d [<!ENTITY a SYSTEM "file:///etc/passwd">]><Dimap_Document>',
    )  # fmt: skip
    assert "declares a document type" in refused(root)
    root = maxar_delivery(tmp_path / "m", taken, isd="")
    changed(one(root, "*.XML"), "<isd>", '<!DOCTYPE d [<!ENTITY a "aaaa">]><isd>')
    assert "declares a document type" in refused(root)


def test_tiles_that_overlap_or_leave_gaps(taken, tmp_path):
    root = maxar_delivery(tmp_path / "m", taken)
    index = one(root, "*.TIL")
    text = index.read_text()
    index.write_text(
        text.replace("ULColOffset = 100;", "ULColOffset = 99;").replace("LRColOffset = 147", "LRColOffset = 146")
    )
    assert "overlap" in refused(root)
    index.write_text(
        text.replace("ULRowOffset = 140;", "ULRowOffset = 141;").replace("LRRowOffset = 147", "LRRowOffset = 148")
    )
    assert "so some are missing" in refused(root)
    index.write_text(text.replace("LRColOffset = 147", "LRColOffset = 160"))
    assert "ends at row" in refused(root)
    index.write_text(text.replace("ULColOffset = 100;", "ULColOffset = 1e3;"))
    assert "not a whole number" in refused(root)
    index.write_text(text.partition("END_GROUP = TILE_2")[0])
    assert "stops within the group 'TILE_2'" in refused(root)
    index.write_text("BEGIN_GROUP = IMAGE\nEND_GROUP = IMAGE\nEND;\n")
    assert "names no file of pixels" in refused(root)


def test_a_tile_of_other_pixels(taken, tmp_path):
    root = maxar_delivery(tmp_path / "m", taken)
    write_image(one(root, "*R2C1*.TIF"), np.zeros((70, 100), np.uint8))
    assert "has other bands or pixels than" in refused(root)


def test_metadata_that_contradict_each_other(taken, tmp_path):
    root = maxar_delivery(tmp_path / "m", taken)
    changed(one(root, "*P1BS*.IMD"), "numRows = 148;", "numRows = 149;")
    assert "say that the image has 149 x 148 pixels" in refused(root)
    changed(one(root, "*P1BS*.IMD"), "numRows = 149;", "numRows = 148;\nnumRows = 150;")
    assert "gives 'numRows' twice, with different values" in refused(root)
    root = dimap_delivery(tmp_path / "d", taken)
    changed(one(root, "DIM_*_MS_*.XML"), "<NROWS>36</NROWS>", "<NROWS>38</NROWS>")
    assert "say that the image has 38 x 37 pixels" in refused(root)
    root = dimap_delivery(tmp_path / "e", taken)
    rpc = one(root, "RPC_*_P_*.XML")
    rpc.unlink()
    assert f"names {rpc.name}, which is missing. Add it" in refused(root)
    changed(one(root, "DIM_*_P_*.XML"), f'href="{rpc.name}"', 'href="none"')
    assert f"holds no RPC and names none. Add {rpc.name} beside it" in refused(root)


def test_parts_of_a_product_that_are_missing(taken, tmp_path):
    root = maxar_delivery(tmp_path / "m", taken)
    one(root, "*M1BS*.TIF").unlink()
    assert "Copy the whole product again" in refused(root)
    root = maxar_delivery(tmp_path / "r", taken)
    one(root, "*P1BS*.RPB").unlink()
    assert ".RPB with its RPC beside it. Add it" in refused(root)
    root = maxar_delivery(tmp_path / "isd", taken, isd="")
    one(root, "*P1BS*.XML").unlink()
    assert ".XML with its RPC beside it. Add it" in refused(root)
    root = gaofen_delivery(tmp_path / "g", taken)
    one(root, "*PAN1.rpb").unlink()
    assert "PAN1.rpb is missing beside it. Add it" in refused(root)
    root = dimap_delivery(tmp_path / "d", taken)
    index = one(root, "DIM_*_P_*.XML")
    index.unlink()
    assert re.search(rf"{index} is missing, .* how IMG_.*_R1C1.TIF and 5 more tiles lie", refused(root))


def test_all_faults_of_a_delivery_are_found(taken, tmp_path):
    root = maxar_delivery(tmp_path / "m", taken)
    one(root, "*P001_PAN/*P1BS*.RPB").unlink()
    one(root, "*P002_PAN/*R2C1*.TIF").unlink()
    usable = open_usable_views([root])
    assert usable.scene is None
    assert "RPB with its RPC beside it" in usable.refused[0].reason
    assert "R2C1" in usable.refused[1].reason
    assert len(usable.refused) == 2
    root = maxar_delivery(tmp_path / "one", taken)
    changed(one(root, "*P001_PAN/*.IMD"), "numRows = 148;", "numRows = 148;\nnumRows = 150;")
    usable = open_usable_views([root])
    # The multispectral image of the pass is no view of its own.
    assert [view.name for view in usable.scene.views] == ["WV03_20141005T160218"]
    assert "gives 'numRows' twice" in usable.refused[0].reason
    assert len(usable.refused) == 1


def test_a_damaged_rpc_does_not_hide_the_other_images(taken, tmp_path):
    root = planet_delivery(tmp_path / "d", taken)
    rpc = one(root, "*nadir_basic_panchromatic_dn_RPC.TXT")
    rpc.write_text(rpc.read_text()[:1500])
    usable = open_usable_views([root])
    assert len(usable.scene.views) == 1
    assert [each.path.name.partition("_basic")[2] for each in usable.refused] == ["_panchromatic_dn.tif"]
    assert rpc.name in usable.refused[0].reason


@pytest.mark.parametrize(("write", "rpc"), [(dimap_delivery, "RPC_*_MS_*.XML"), (maxar_delivery, "*M1BS*.RPB")])
def test_a_multispectral_image_without_an_rpc_gives_no_colours(taken, tmp_path, write, rpc):
    root = write(tmp_path / "d", taken)
    one(root, rpc).unlink()
    delivery = open_delivery(root)
    assert sorted(view.partner is None for view in delivery.views) == [False, True]
    assert " (gives no colours: " in describe(delivery)
    assert not delivery.is_doubtful


def test_ortho_images_are_named(taken, tmp_path):
    root = dimap_delivery(tmp_path / "d", taken)
    for index in root.rglob("DIM_*.XML"):
        changed(index, "<RASTER_GEOMETRY>SENSOR", "<RASTER_GEOMETRY>GROUND")
    assert "is an ortho-image, whose pixels have no camera: order the product as PRIMARY" in refused(root)


@pytest.mark.parametrize(
    ("href", "says"),
    [
        ("../../../secret.tif", "does not lie below"),
        ("/etc/passwd", "does not lie below"),
        ("https://server/pan.tif", "lies on a server, and is not fetched"),
        ("./none.tif", "which is missing"),
        ("", "is no path"),
    ],
)
def test_assets_of_stac_elsewhere(taken, tmp_path, href, says):
    catalogue = stac_delivery(tmp_path / "c", taken)
    item = one(catalogue.parent, "item.json")
    document = json.loads(item.read_text())
    document["assets"]["pan"]["href"] = href
    item.write_text(json.dumps(document))
    assert says in refused(catalogue)
    assert says in refused(catalogue.parent)


def test_a_catalogue_whose_item_is_missing(taken, tmp_path):
    catalogue = stac_delivery(tmp_path / "c", taken)
    one(catalogue.parent, "item.json").unlink()
    assert "item.json', which is missing" in refused(catalogue)
    assert "item.json', which is missing" in refused(catalogue.parent)
    document = json.loads(catalogue.read_text())
    for link in document["links"]:
        link["href"] = f"https://server/{link['href']}"
    catalogue.write_text(json.dumps(document))
    assert "pan.tif" not in str(open_delivery(catalogue.parent).set_aside)


def test_catalogues_that_lead_back_or_are_none(taken, tmp_path):
    catalogue = stac_delivery(tmp_path / "c", taken)
    document = json.loads(catalogue.read_text())
    document["links"].append({"rel": "child", "href": "./catalog.json"})
    catalogue.write_text(json.dumps(document))
    assert len(open_delivery(catalogue).views) == 2
    catalogue.write_text("{}")
    assert "it does not say its stac_version" in refused(catalogue)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ("image,day\nnadir.tif,2014-10-05\n", "is no table of dates"),
        ("image,date\nnadir.tif,2014-10-05\nnadir.tif,2014-10-06\n", "line 3: 'nadir' is there twice"),
        ("image,date\nnadir.tif,2014-13-05\n", "line 2: '2014-13-05' is no day"),
        ("", "dates.csv is empty. Fill it, or remove it."),
        ("image,date\n", "has no line below the names of its columns"),
        ("image;date\nnadir.tif;2014-10-05\n", "has semicolons between its columns. Write commas"),
        (
            "image,date,sunaz\nnadir.tif,2014-10-05,3\n",
            "line 1: the column 'sunaz' is not known. Known are image, date",
        ),
        ("image,date\n\nnadir.tif,2014-10-05,3\n", "line 3: it has more values than the first line names columns"),
        ("image,date\n,2014-10-05\n", "line 2: it names no image"),
        ("image,date,sun_azimuth,sun_elevation\nnadir.tif,2014-10-05,950,50\n", "line 2: '950' in sun_azimuth is not"),
        ("image,date,sun_azimuth,sun_elevation\nnadir.tif,2014-10-05,150,0\n", "line 2: '0' in sun_elevation is not"),
        ("image,date,sun_azimuth\nnadir.tif,2014-10-05,150\n", "line 2: sun_azimuth tells no direction without"),
        ("image,date,cloud_cover\nnadir.tif,2014-10-05,50\n", "line 2: '50' in cloud_cover is not a share from 0 to 1"),
        ("image,date,incidence\nnadir.tif,2014-10-05,abc\n", "line 2: 'abc' in incidence is not an angle from -89"),
    ],
)
def test_tables_of_dates_that_are_none(taken, tmp_path, table, says):
    write_single(tmp_path, taken[0])
    (tmp_path / "dates.csv").write_text(table)
    assert says in refused(tmp_path)


def test_a_table_of_more_images_than_are_here(taken, tmp_path):
    """A folder may hold a part of the images of an archive, with the table of all of them."""
    write_single(tmp_path, taken[0])
    (tmp_path / "dates.csv").write_text("image,date\nnadir.tif,2014-10-05\nfoo.tif,2014-10-05\n")
    with pytest.warns(ZlocusWarning, match=r"names images that are not in this folder: foo\.tif \(line 3\)\."):
        (view,) = open_delivery(tmp_path).views
    assert view.image.acquisition.date == datetime.date(2014, 10, 5)


def test_folders_too_deep_and_links_that_lead_back(taken, tmp_path):
    for shot in taken:
        write_single(tmp_path / "d" / "inner", shot)
    (tmp_path / "d" / "inner" / "again").symlink_to(tmp_path / "d")
    assert len(open_delivery(tmp_path / "d").views) == 2
    (tmp_path.joinpath("d", *["a"] * 20)).mkdir(parents=True)
    assert "deeper than deliveries go" in refused(tmp_path / "d")
