"""Malicious virtual rasters: no server is contacted, no code runs, and no file without pixels is read."""

from __future__ import annotations

import os
import socket
import zipfile
from pathlib import Path

import numpy as np
import pytest
from rasterio.shutil import copy as copy_raster
from rasterio.transform import from_origin
from rasterio.vrt import WarpedVRT

from rpc_fixtures import write_image
from zlocus.core.errors import InputError
from zlocus.io.images import open_image
from zlocus.io.open_raster import open_raster

PIXELS = np.arange(1, 17, dtype=np.uint8).reshape(4, 4)
SOURCE = '<SourceFilename relativeToVRT="{}">{}</SourceFilename>'
PLAIN = (
    '<VRTRasterBand dataType="Byte" band="1"><SimpleSource>{}<SourceBand>1</SourceBand></SimpleSource></VRTRasterBand>'
)
DERIVED = """<VRTRasterBand dataType="Byte" band="1" subClass="VRTDerivedRasterBand" {}><SimpleSource>{}<SourceBand>1
</SourceBand></SimpleSource>{}</VRTRasterBand>"""
RAW = """<VRTRasterBand dataType="Byte" band="1" subClass="VRTRawRasterBand">{}<ImageOffset>0</ImageOffset>
<PixelOffset>1</PixelOffset><LineOffset>4</LineOffset></VRTRasterBand>"""
WARPED = """<VRTRasterBand dataType="Byte" band="1" subClass="VRTWarpedRasterBand"/><GDALWarpOptions>
<SourceDataset relativeToVRT="0">{}</SourceDataset></GDALWarpOptions>"""
CODE = """<PixelFunctionType>{}</PixelFunctionType>{}<PixelFunctionCode><![CDATA[
import os
os.mkdir("{}")
def f(ins, out, *rest, **more):
    out[:] = ins[0]
]]></PixelFunctionCode>"""
PYTHON = "<PixelFunctionLanguage>Python</PixelFunctionLanguage>"
SERVICE = """<GDAL_WMS><Service name="TMS"><ServerUrl>{}/${{z}}/${{x}}/${{y}}.png</ServerUrl></Service><DataWindow>
<UpperLeftX>0</UpperLeftX><UpperLeftY>4</UpperLeftY><LowerRightX>4</LowerRightX><LowerRightY>0</LowerRightY>
<SizeX>256</SizeX><SizeY>256</SizeY></DataWindow><BandsCount>1</BandsCount></GDAL_WMS>"""


def virtual(bands, attributes=""):
    """A virtual raster of 4 x 4 pixels."""
    return f"""<VRTDataset rasterXSize="4" rasterYSize="4" {attributes}><SRS>EPSG:32632</SRS>
    <GeoTransform>0, 1, 0, 4, 0, -1</GeoTransform><Metadata><MDI key="URL">http://a.b/c</MDI></Metadata>{bands}
    </VRTDataset>"""


def plain(source, is_relative=0):
    return virtual(PLAIN.format(SOURCE.format(is_relative, source)))


class Place:
    """A folder with an image, and the address of a server that notes whether it is asked."""

    def __init__(self, folder: Path, listener: socket.socket) -> None:
        self.folder, self.listener = folder, listener
        self.server = f"http://127.0.0.1:{listener.getsockname()[1]}"
        self.there = f"/vsicurl/{self.server}/a.tif"
        self.image = write_image(folder / "image.tif", PIXELS)
        self.made = folder / "made"

    def written(self, name: str, text: str) -> str:
        (self.folder / name).write_text(text)
        return name

    def is_asked(self) -> bool:
        try:
            self.listener.accept()[0].close()
        except BlockingIOError:
            return False
        return True


@pytest.fixture
def place(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setblocking(False)
        yield Place(tmp_path, listener)


def zipped(p):
    with zipfile.ZipFile(p.folder / "zip.tif", "w") as file:
        file.write(p.image, "img.tif")
    return "zip.tif"


def code(p, name="f", language=PYTHON):
    return CODE.format(name, language, p.made)


# What a virtual raster reaches for, and how.
REACHES = {
    "a server": lambda p: plain(p.there),
    "a server without GDAL's name": lambda p: plain(f"{p.server}/a.tif"),
    "a server in an attribute": lambda p: virtual(
        PLAIN.format("").replace("<SimpleSource>", f'<SimpleSource SourceFilename="{p.there}">')
    ),
    "a server in a name space": lambda p: virtual(PLAIN.format(SOURCE.format(0, p.there)), 'xmlns="http://a.b/c"'),
    "a server that is warped": lambda p: virtual(WARPED.format(p.there), 'subClass="VRTWarpedDataset"'),
    "a server for the places": lambda p: virtual(
        f'<Metadata domain="GEOLOCATION"><MDI key="X_DATASET">{p.there}</MDI></Metadata>'
        + PLAIN.format(SOURCE.format(0, p.image))
    ),
    "a service by its name": lambda p: plain(f"WMS:{p.server}/?layers=a"),
    "a service as a document": lambda p: plain(SERVICE.format(p.server).replace("<", "&lt;")),
    "a service in a file": lambda p: plain(p.written("service.tif", SERVICE.format(p.server)), 1),
    "another list": lambda p: plain(p.written("nested.vrt", plain(p.there)), 1),
    "another list under another name": lambda p: plain(p.written("nested.tif", plain(p.there)), 1),
    "itself": lambda p: plain("evil.vrt", 1),
    "itself through another": lambda p: plain(p.written("nested.vrt", plain("evil.vrt", 1)), 1),
    "an archive": lambda p: plain(f"/vsizip/{p.folder}/{zipped(p)}/img.tif"),
    "an archive under another name": lambda p: plain(zipped(p), 1),
    "a stream": lambda p: plain("/vsistdin/"),
    "GDAL's own language": lambda p: plain(f"vrt://{p.image}?bands=1"),
    "passwords": lambda p: plain("/etc/passwd"),
    "bytes of passwords": lambda p: virtual(RAW.format(SOURCE.format(0, "/etc/passwd"))),
    "bytes of passwords on a way": lambda p: virtual(
        RAW.format(SOURCE.format(1, os.path.relpath("/etc/passwd", p.folder)))
    ),
    "code": lambda p: virtual(DERIVED.format("", SOURCE.format(0, p.image), code(p))),
    "code of a module": lambda p: virtual(DERIVED.format("", SOURCE.format(0, p.image), code(p, "os.path.join"))),
    "code in an attribute": lambda p: virtual(
        DERIVED.format('PixelFunctionLanguage="Python"', SOURCE.format(0, p.image), code(p, language=""))
    ),
    "an image in a way that is none": lambda p: plain(p.image, 2),
    "nothing": lambda p: plain("nothing.tif", 1),
    "a folder": lambda p: plain(p.folder),
    "the end of the file": lambda p: plain(p.image)[:-20],
    "a document type": lambda p: f"<!DOCTYPE a [<!ENTITY b 'c'>]>{plain(p.image)}",
}  # fmt: skip


@pytest.mark.parametrize("what", REACHES)
def test_a_list_reaches_for_nothing_but_pixels(place, monkeypatch, what):
    """Not either where the user's own programs let GDAL run code."""
    monkeypatch.setenv("GDAL_VRT_ENABLE_PYTHON", "YES")
    place.written("evil.vrt", REACHES[what](place))
    with pytest.raises(InputError) as refused:
        open_image(place.folder / "evil.vrt")
    assert "\n" not in str(refused.value)
    assert "list of files" in str(refused.value) or what in ("passwords", "the end of the file", "a document type")
    assert not place.is_asked()
    assert not place.made.exists()


@pytest.mark.parametrize("is_linked", [False, True])
def test_a_list_of_images_is_read(place, is_linked):
    """From where it lies, one in another; with pixels as they are that lie beside it; and by functions of GDAL."""
    (place.folder / "below").mkdir()
    (place.folder / "below" / "bytes.bin").write_bytes(PIXELS.tobytes())
    function = "<PixelFunctionType>real</PixelFunctionType><PixelFunctionLanguage>C</PixelFunctionLanguage>"
    lists = {
        "absolute.vrt": plain(place.image), "relative.vrt": plain("image.tif", 1),
        "nested.vrt": plain("relative.vrt", 1), "raw.vrt": virtual(RAW.format(SOURCE.format(1, "below/bytes.bin"))),
        "function.vrt": virtual(DERIVED.format("", SOURCE.format(1, "image.tif"), function)),
    }  # fmt: skip
    for name, text in lists.items():
        place.written(name, text)
        path = place.folder / name
        if is_linked:
            path = place.folder / "below" / name
            path.symlink_to(place.folder / name)
        np.testing.assert_array_equal(open_image(path).read(0, 0, 4, 4).pixels, PIXELS)


def test_a_list_that_gdal_writes_is_read(place):
    """With all that GDAL says of it, and where it is warped."""
    at = {"transform": from_origin(5e5, 5e6, 2.0, 2.0), "crs": "EPSG:32632"}
    placed = write_image(place.folder / "placed.tif", PIXELS, **at)
    with open_raster(placed) as source, WarpedVRT(source, crs="EPSG:32633") as warped:
        copy_raster(source, place.folder / "copy.vrt", driver="VRT")
        copy_raster(warped, place.folder / "warped.vrt", driver="VRT")
    np.testing.assert_array_equal(open_image(place.folder / "copy.vrt").read(0, 0, 4, 4).pixels, PIXELS)
    assert "VRTWarpedDataset" in (place.folder / "warped.vrt").read_text()
    assert set(np.unique(open_image(place.folder / "warped.vrt").read(0, 0, 4, 4).pixels)) <= {0, *PIXELS.ravel()}


def test_a_list_that_changes_is_looked_at_again(place):
    path = place.folder / "list.vrt"
    path.write_text(plain(place.image))
    assert open_image(path).shape == (4, 4)
    path.write_text(plain(place.there))
    with pytest.raises(InputError, match="which is none"):
        open_image(path)
    assert not place.is_asked()
