"""A small analytic RPC and the text of the files it can come in."""

from __future__ import annotations

import warnings

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from zlocus.products.rpc_copies import gdal_rpc
from zlocus.sensors.rpc import RpcCoefficients

RPC_NAMES = ("LINE_NUM", "LINE_DEN", "SAMP_NUM", "SAMP_DEN")


def satellite_rpc() -> RpcCoefficients:
    """A tilted view with mild cubic terms: 0.5 m pixels, a box of 20 x 20 km and +-500 m."""
    rng = np.random.default_rng(7)
    small = rng.normal(scale=2e-4, size=(4, 20))
    small[:, 10:] *= 0.05
    line_num, line_den, samp_num, samp_den = small
    line_num[:4] += (0.01, 0.05, -1.02, 0.02)
    samp_num[:4] += (-0.02, 1.01, 0.04, -0.03)
    line_den[0] = samp_den[0] = 1.0
    return RpcCoefficients(
        line_off=19500.25, samp_off=20100.75, lat_off=43.25, lon_off=5.5, height_off=450.0,
        line_scale=20000.0, samp_scale=20000.0, lat_scale=0.09, lon_scale=0.125, height_scale=500.0,
        line_num=tuple(line_num.tolist()), line_den=tuple(line_den.tolist()),
        samp_num=tuple(samp_num.tolist()), samp_den=tuple(samp_den.tolist()),
    )  # fmt: skip


def write_image(path, pixels, rpc: RpcCoefficients | None = None, **profile):
    """A GeoTIFF of pixels (r, c) or (bands, r, c), without georeference other than the RPC."""
    bands = pixels if pixels.ndim == 3 else pixels[np.newaxis]
    profile = {"driver": "GTiff", "count": len(bands), "height": bands.shape[1], "width": bands.shape[2]} | profile
    if rpc is not None:
        profile["rpcs"] = gdal_rpc(rpc)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", dtype=bands.dtype, **profile) as image:
            image.write(bands)
    return path


def rpc_txt(rpc: RpcCoefficients) -> str:
    offsets = zip(
        ("LINE", "SAMP", "LAT", "LONG", "HEIGHT"),
        (rpc.line_off, rpc.samp_off, rpc.lat_off, rpc.lon_off, rpc.height_off),
        (rpc.line_scale, rpc.samp_scale, rpc.lat_scale, rpc.lon_scale, rpc.height_scale),
        ("pixels", "pixels", "degrees", "degrees", "meters"),
        strict=True,
    )
    rows = list(offsets)
    lines = [f"{name}_OFF: {offset:+.17g} {unit}" for name, offset, _, unit in rows]
    lines += [f"{name}_SCALE: {scale:+.17g} {unit}" for name, _, scale, unit in rows]
    for name, numbers in _polynomials(rpc):
        lines += [f"{name}_COEFF_{i}: {number:+.17g}" for i, number in enumerate(numbers, 1)]
    return "\n".join(lines) + "\n"


def rpb(rpc: RpcCoefficients) -> str:
    def numbers(values):
        return "(\n" + ",\n".join(f"\t\t\t{value:+.17E}" for value in values) + ");"

    return f"""satId = "WV02";
bandId = "P";
SpecId = "RPC00B";
BEGIN_GROUP = IMAGE
\terrBias =   0.31;
\terrRand =   0.12;
\tlineOffset = {rpc.line_off!r};
\tsampOffset = {rpc.samp_off!r};
\tlatOffset = {rpc.lat_off!r};
\tlongOffset = {rpc.lon_off!r};
\theightOffset = {rpc.height_off!r};
\tlineScale = {rpc.line_scale!r};
\tsampScale = {rpc.samp_scale!r};
\tlatScale = {rpc.lat_scale!r};
\tlongScale = {rpc.lon_scale!r};
\theightScale = {rpc.height_scale!r};
\tlineNumCoef = {numbers(rpc.line_num)}
\tlineDenCoef = {numbers(rpc.line_den)}
\tsampNumCoef = {numbers(rpc.samp_num)}
\tsampDenCoef = {numbers(rpc.samp_den)}
END_GROUP = IMAGE
END;
"""


def dimap_rpc(rpc: RpcCoefficients, *, version: int = 2, first_pixel: float = 1.0) -> str:
    """An RPC_*.XML whose offsets count the first pixel as `first_pixel`; its direct model is deliberately nonsense."""
    direct, inverse = (
        ("Direct_Model", "Inverse_Model") if version == 2 else ("ImagetoGround_Values", "GroundtoImage_Values")
    )
    domain = "Direct_Model_Validity_Domain" if version == 2 else "ImagetoGround_Validity_Domain"
    coefficients = "\n".join(
        f"<{name}_COEFF_{i}>{number!r}</{name}_COEFF_{i}>"
        for name, numbers in reversed(_polynomials(rpc))
        for i, number in enumerate(map(float, numbers), 1)
    )
    nonsense = "\n".join(f"<{name}_COEFF_{i}>99.0</{name}_COEFF_{i}>" for name in RPC_NAMES for i in range(1, 21))
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<Dimap_Document>
<Metadata_Identification><METADATA_FORMAT version="{version}.0">DIMAP</METADATA_FORMAT></Metadata_Identification>
<Rational_Function_Model><Resource_Reference/>
<Global_RFM>
<{direct}>{nonsense}<ERR_BIAS_X>0.1</ERR_BIAS_X></{direct}>
<{inverse}>{coefficients}<ERR_BIAS_ROW>0.1</ERR_BIAS_ROW></{inverse}>
<RFM_Validity>
<{domain}><FIRST_ROW>{first_pixel}</FIRST_ROW><FIRST_COL>{first_pixel}</FIRST_COL></{domain}>
<LONG_SCALE>{rpc.lon_scale!r}</LONG_SCALE><LONG_OFF>{rpc.lon_off!r}</LONG_OFF>
<LAT_SCALE>{rpc.lat_scale!r}</LAT_SCALE><LAT_OFF>{rpc.lat_off!r}</LAT_OFF>
<HEIGHT_SCALE>{rpc.height_scale!r}</HEIGHT_SCALE><HEIGHT_OFF>{rpc.height_off!r}</HEIGHT_OFF>
<SAMP_SCALE>{rpc.samp_scale!r}</SAMP_SCALE><SAMP_OFF>{rpc.samp_off + first_pixel!r}</SAMP_OFF>
<LINE_SCALE>{rpc.line_scale!r}</LINE_SCALE><LINE_OFF>{rpc.line_off + first_pixel!r}</LINE_OFF>
</RFM_Validity>
</Global_RFM>
</Rational_Function_Model>
</Dimap_Document>
"""


def dimap_dim(images: dict[str, tuple[int, int]], tile: tuple[int, int], rpc_file: str | None = None) -> str:
    """A DIM_*.XML that lists image files with their (tile row, tile column), tiles of (rows, columns) pixels."""
    files = "".join(
        f'<Data_File tile_R="{row}" tile_C="{col}"><DATA_FILE_PATH href="{name}"/></Data_File>'
        for name, (row, col) in images.items()
    )
    component = "" if rpc_file is None else f'<Component><COMPONENT_PATH href="{rpc_file}"/></Component>'
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<Dimap_Document>
<Dataset_Content><Dataset_Components>{component}</Dataset_Components></Dataset_Content>
<Raster_Data><Data_Access><Data_Files>{files}</Data_Files></Data_Access>
<Raster_Dimensions><Tile_Set><Regular_Tiling>
<NTILES_SIZE nrows="{tile[0]}" ncols="{tile[1]}"/>
<OVERLAP_ROW unit="pixel">0</OVERLAP_ROW><OVERLAP_COL unit="pixel">0</OVERLAP_COL>
</Regular_Tiling></Tile_Set></Raster_Dimensions></Raster_Data>
</Dimap_Document>
"""


def _polynomials(rpc: RpcCoefficients):
    return list(zip(RPC_NAMES, (rpc.line_num, rpc.line_den, rpc.samp_num, rpc.samp_den), strict=True))
