"""Small deliveries with the structure of each vendor's products, made from rendered images of two views."""

from __future__ import annotations

import datetime
import json
import warnings
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

from mask_files import box, gml
from rpc_fixtures import dimap_rpc, rpb, rpc_txt, write_image
from zlocus.io.cameras.rpc import read_rpc
from zlocus.products.rpc_copies import gdal_rpc
from zlocus.sensors.rpc import RpcCoefficients

# A pixel of a multispectral image is as wide as so many of the panchromatic one.
RATIO = 4
# Its bands are so many times the grey value: blue, green, red, near infrared.
GAINS = {"B": 0.5, "G": 0.75, "R": 1.0, "N": 1.25}
# Columns and rows that masks call cloud: the first, and the first beyond.
CLOUDED = (40, 20, 70, 60)
FIRST_TIME = datetime.datetime(2014, 10, 5, 16, 1, 38, tzinfo=datetime.UTC)
SECONDS_APART = 40
SUN_AZIMUTH, SUN_ELEVATION, VIEW_AZIMUTH, VIEW_ELEVATION, OFF_NADIR, CLOUD = 158.4, 51.2, 212.0, 70.5, 17.5, 0.25


@dataclass(frozen=True)
class Shot:
    """A panchromatic and a multispectral image of one pass. colours : by letter of the band."""

    name: str
    time: datetime.datetime
    grey: NDArray[np.uint16]
    rpc: RpcCoefficients
    colours: dict[str, NDArray[np.uint16]]
    colour_rpc: RpcCoefficients

    @property
    def is_cloudy(self) -> NDArray[np.bool_]:
        """The pixels under `CLOUDED`, (r, c)."""
        found = np.zeros(self.grey.shape, np.bool_)
        left, top, right, bottom = CLOUDED
        found[top:bottom, left:right] = True
        return found

    def bands(self, letters: str) -> NDArray[np.uint16]:
        return np.stack([self.colours[letter] for letter in letters])


def shots(paths: dict[str, Path]) -> list[Shot]:
    """The shots of some rendered images, each some seconds after the one before."""
    found = []
    for number, (name, path) in enumerate(paths.items()):
        with rasterio.open(path) as source:
            whole = source.read(1).astype(np.uint16)
        rows, cols = (side // RATIO * RATIO for side in whole.shape)
        grey, rpc = np.ascontiguousarray(whole[:rows, :cols]), read_rpc(path)
        means = grey.reshape(rows // RATIO, RATIO, cols // RATIO, RATIO).mean(axis=(1, 3))
        colours = {letter: np.rint(gain * means).astype(np.uint16) for letter, gain in GAINS.items()}
        smaller = replace(
            rpc,
            samp_off=(rpc.samp_off + 0.5) / RATIO - 0.5, line_off=(rpc.line_off + 0.5) / RATIO - 0.5,
            samp_scale=rpc.samp_scale / RATIO, line_scale=rpc.line_scale / RATIO,
        )  # fmt: skip
        time = FIRST_TIME + datetime.timedelta(seconds=SECONDS_APART * number)
        found.append(Shot(name, time, grey, rpc, colours, smaller))
    return found


def tiles_of(pixels: NDArray[np.uint16], size: tuple[int, int]) -> dict[tuple[int, int], NDArray[np.uint16]]:
    """The tiles of an image, by row and column of the tile, from 1."""
    whole = pixels if pixels.ndim == 3 else pixels[np.newaxis]
    rows, cols = size
    return {
        (down + 1, across + 1): whole[:, down * rows : (down + 1) * rows, across * cols : (across + 1) * cols]
        for down in range(-(-whole.shape[1] // rows))
        for across in range(-(-whole.shape[2] // cols))
    }


def write_single(folder: Path, shot: Shot) -> Path:
    """The panchromatic image as a single file with its RPC beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    path = write_image(folder / f"{shot.name}.tif", shot.grey)
    path.with_name(f"{shot.name}_RPC.TXT").write_text(rpc_txt(shot.rpc))
    return path


def dimap_delivery(root: Path, taken: list[Shot], tile: tuple[int, int] | None = (70, 100)) -> Path:
    """Pleiades primary bundles: a folder for the panchromatic and one for the multispectral image of each shot.

    tile : rows and columns of the tiles of the panchromatic image; None: one tile.
    """
    for shot in taken:
        stamp = f"{shot.time:%Y%m%d%H%M%S}1"
        for kind, pixels, rpc in (("P", shot.grey, shot.rpc), ("MS", shot.bands("RGBN"), shot.colour_rpc)):
            name = f"PHR1A_{kind}_{stamp}_SEN_{shot.name}-001"
            folder = root / f"PROD_{shot.name}" / f"VOL_PHR1A_001_A/IMG_PHR1A_{kind}_001"
            size = tile if kind == "P" and tile else pixels.shape[-2:]
            (folder / "MASKS").mkdir(parents=True)
            files = {}
            for at, part in tiles_of(pixels, size).items():
                files[f"IMG_{name}_R{at[0]}C{at[1]}.TIF"] = at
                write_image(folder / f"IMG_{name}_R{at[0]}C{at[1]}.TIF", part)
            (folder / f"RPC_{name}.XML").write_text(dimap_rpc(rpc))
            (folder / f"DIM_{name}.XML").write_text(_dim(shot, kind, pixels.shape, size, files, name))
            (folder / f"PREVIEW_{name}.JPG").write_bytes(b"\xff\xd8\xff\xe0")
            # Masks count the first pixel as (1, 1), at its centre.
            left, top, right, bottom = (edge + 0.5 for edge in CLOUDED)
            gml(folder / "MASKS" / f"CLD_{name}_MSK.GML", box(left, top, right, bottom))
            gml(folder / "MASKS" / f"SNW_{name}_MSK.GML", box(1, 1, 30, 30), kind="SNOW", title="Snow mask")
            gml(folder / "MASKS" / f"QTE_{name}_MSK.GML", kind="QUALITY", title="Quality mask")
    return root


def _dim(shot: Shot, kind: str, shape, size, files, name: str) -> str:
    bands = "" if kind == "P" else "".join(
        f"<Raster_Index><BAND_ID>{band}</BAND_ID><BAND_INDEX>{number}</BAND_INDEX></Raster_Index>"
        for number, band in enumerate(("B2", "B1", "B0", "B3"), 1)
    )  # fmt: skip
    shown = ("P", "P", "P") if kind == "P" else ("B2", "B1", "B0")
    order = "".join(
        f"<{colour}_CHANNEL>{band}</{colour}_CHANNEL>"
        for colour, band in zip(("RED", "GREEN", "BLUE"), shown, strict=True)
    )
    listed = "".join(
        f'<Data_File tile_R="{row}" tile_C="{col}"><DATA_FILE_PATH href="{file}"/></Data_File>'
        for file, (row, col) in files.items()
    )
    place = f"""<Located_Geometric_Values><LOCATION_TYPE>Center</LOCATION_TYPE>
<Acquisition_Angles><AZIMUTH_ANGLE unit="deg">{VIEW_AZIMUTH}</AZIMUTH_ANGLE>
<VIEWING_ANGLE unit="deg">{OFF_NADIR}</VIEWING_ANGLE>
<INCIDENCE_ANGLE_ALONG_TRACK unit="deg">{90 - VIEW_ELEVATION}</INCIDENCE_ANGLE_ALONG_TRACK>
<INCIDENCE_ANGLE_ACROSS_TRACK unit="deg">0.0</INCIDENCE_ANGLE_ACROSS_TRACK>
<INCIDENCE_ANGLE unit="deg">{90 - VIEW_ELEVATION}</INCIDENCE_ANGLE></Acquisition_Angles>
<Solar_Incidences><SUN_AZIMUTH unit="deg">{SUN_AZIMUTH}</SUN_AZIMUTH>
<SUN_ELEVATION unit="deg">{SUN_ELEVATION}</SUN_ELEVATION></Solar_Incidences></Located_Geometric_Values>"""
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<Dimap_Document>
<Metadata_Identification><METADATA_FORMAT version="2.0">DIMAP</METADATA_FORMAT></Metadata_Identification>
<Dataset_Content><CLOUD_COVERAGE unit="percent">{100 * CLOUD}</CLOUD_COVERAGE></Dataset_Content>
<Geoposition><Raster_CRS><RASTER_GEOMETRY>SENSOR</RASTER_GEOMETRY></Raster_CRS>
<Geoposition_Models><Rational_Function_Model><Component><COMPONENT_PATH href="RPC_{name}.XML"/></Component>
</Rational_Function_Model></Geoposition_Models></Geoposition>
<Processing_Information><Product_Settings><SPECTRAL_PROCESSING>{kind}</SPECTRAL_PROCESSING></Product_Settings>
</Processing_Information>
<Raster_Data><Data_Access><Data_Files>{listed}</Data_Files></Data_Access>
<Raster_Dimensions><NROWS>{shape[-2]}</NROWS><NCOLS>{shape[-1]}</NCOLS>
<NBANDS>{shape[0] if len(shape) == 3 else 1}</NBANDS>
<Tile_Set><Regular_Tiling><NTILES_SIZE nrows="{size[0]}" ncols="{size[1]}"/><OVERLAP_ROW>0</OVERLAP_ROW>
<OVERLAP_COL>0</OVERLAP_COL></Regular_Tiling></Tile_Set></Raster_Dimensions>
<Raster_Display><Raster_Index_List>{bands}</Raster_Index_List><Band_Display_Order>{order}</Band_Display_Order>
</Raster_Display></Raster_Data>
<Quality_Assessment><Imaging_Quality_Measurement>
<Quality_Mask><Component><COMPONENT_PATH href="MASKS/CLD_{name}_MSK.GML"/></Component></Quality_Mask>
<Quality_Mask><Component><COMPONENT_PATH href="MASKS/SNW_{name}_MSK.GML"/></Component></Quality_Mask>
<Quality_Mask><Component><COMPONENT_PATH href="MASKS/QTE_{name}_MSK.GML"/></Component></Quality_Mask>
</Imaging_Quality_Measurement></Quality_Assessment>
<Geometric_Data><Use_Area>{place}</Use_Area></Geometric_Data>
<Dataset_Sources><Source_Identification><Strip_Source><MISSION>PHR</MISSION><MISSION_INDEX>1A</MISSION_INDEX>
<IMAGING_DATE>{shot.time:%Y-%m-%d}</IMAGING_DATE><IMAGING_TIME>{shot.time:%H:%M:%S}.0Z</IMAGING_TIME></Strip_Source>
</Source_Identification></Dataset_Sources>
</Dimap_Document>
"""


def maxar_delivery(root: Path, taken: list[Shot], tile: tuple[int, int] = (70, 100), isd: str | None = None) -> Path:
    """WorldView basic products: `*_PAN` with tiles and a .TIL, `*_MUL` with one .TIF.

    isd : namespace of the XML that holds what .IMD and .RPB would hold ("" for none); None: there are .IMD and .RPB.
    """
    for number, shot in enumerate(taken, 1):
        for level, pixels, rpc in (("P1BS", shot.grey, shot.rpc), ("M1BS", shot.bands("BGRN"), shot.colour_rpc)):
            name = f"{shot.time:%y%b%d%H%M%S}-{level}-500648062040_01_P{number:03}".upper()
            folder = root / f"500648062040_01_P{number:03}_{'PAN' if level == 'P1BS' else 'MUL'}"
            folder.mkdir(parents=True)
            letters = "P" if level == "P1BS" else "BGRN"
            rows, cols = pixels.shape[-2:]
            if level == "P1BS":
                parts = {
                    f"{name[:18]}_R{at[0]}C{at[1]}{name[18:]}.TIF": (at, part)
                    for at, part in tiles_of(pixels, tile).items()
                }
                for file, (_, part) in parts.items():
                    write_image(folder / file, part)
                places = {
                    file: ((at[0] - 1) * tile[0], (at[1] - 1) * tile[1], part) for file, (at, part) in parts.items()
                }
                (folder / f"{name}.TIL").write_text(_til(places))
            else:
                write_image(folder / f"{name}.TIF", pixels)
            if isd is None:
                (folder / f"{name}.IMD").write_text(_imd(shot, letters, rows, cols))
                (folder / f"{name}.RPB").write_text(rpb(rpc))
            else:
                (folder / f"{name}.XML").write_text(_isd(shot, letters, rows, cols, rpc, isd))
            (folder / f"{name}-BROWSE.JPG").write_bytes(b"\xff\xd8\xff\xe0")
    return root


def _til(places) -> str:
    groups = "".join(
        f'BEGIN_GROUP = TILE_{number}\n\tfilename = "{file}";\n\tULColOffset = {col};\n\tULRowOffset = {row};\n'
        f"\tLRColOffset = {col + part.shape[2] - 1};\n\tLRRowOffset = {row + part.shape[1] - 1};\n"
        f"END_GROUP = TILE_{number}\n"
        for number, (file, (row, col, part)) in enumerate(places.items(), 1)
    )
    return f'bandId = "P";\nnumTiles = {len(places)};\ntileUnits = "Pixels";\ntileOverlap = 0;\n{groups}END;\n'


def _imd(shot: Shot, letters: str, rows: int, cols: int) -> str:
    bands = "".join(
        f"BEGIN_GROUP = BAND_{letter}\n\tULLon = 5.5;\n\tabsCalFactor = 1.0e-02;\nEND_GROUP = BAND_{letter}\n"
        for letter in letters
    )
    return (
        f'version = "R";\nbandId = "{"P" if letters == "P" else "Multi"}";\npanSharpenAlgorithm = "None";\n'
        f"numRows = {rows};\nnumColumns = {cols};\n{bands}"
        f'BEGIN_GROUP = IMAGE_1\n\tsatId = "WV03";\n\tfirstLineTime = {shot.time:%Y-%m-%dT%H:%M:%S}.000000Z;\n'
        f"\tmeanSunAz = {SUN_AZIMUTH};\n\tmeanSunEl = {SUN_ELEVATION};\n\tmeanSatAz = {VIEW_AZIMUTH};\n"
        f"\tmeanSatEl = {VIEW_ELEVATION};\n\tmeanOffNadirViewAngle = {OFF_NADIR};\n\tcloudCover = {CLOUD};\n"
        "END_GROUP = IMAGE_1\nEND;\n"
    )


def _isd(shot: Shot, letters: str, rows: int, cols: int, rpc: RpcCoefficients, namespace: str) -> str:
    def numbers(values) -> str:
        return " ".join(repr(float(value)) for value in values)

    bands = "".join(f"<BAND_{letter}><ABSCALFACTOR>0.01</ABSCALFACTOR></BAND_{letter}>" for letter in letters)
    scalars = "".join(
        f"<{name}>{value!r}</{name}>"
        for name, value in (
            ("LINEOFFSET", rpc.line_off), ("SAMPOFFSET", rpc.samp_off), ("LATOFFSET", rpc.lat_off),
            ("LONGOFFSET", rpc.lon_off), ("HEIGHTOFFSET", rpc.height_off), ("LINESCALE", rpc.line_scale),
            ("SAMPSCALE", rpc.samp_scale), ("LATSCALE", rpc.lat_scale), ("LONGSCALE", rpc.lon_scale),
            ("HEIGHTSCALE", rpc.height_scale),
        )
    )  # fmt: skip
    terms = "".join(
        f"<{name}List><{name}>{numbers(values)}</{name}></{name}List>"
        for name, values in (
            ("LINENUMCOEF", rpc.line_num), ("LINEDENCOEF", rpc.line_den), ("SAMPNUMCOEF", rpc.samp_num),
            ("SAMPDENCOEF", rpc.samp_den),
        )
    )  # fmt: skip
    return f"""<?xml version="1.0" encoding="UTF-8" standalone="yes"?>
<isd{f' xmlns="{namespace}"' if namespace else ""}><IMD><VERSION>28.4</VERSION>
<BANDID>{"P" if letters == "P" else "Multi"}</BANDID>
<NUMROWS>{rows}</NUMROWS><NUMCOLUMNS>{cols}</NUMCOLUMNS>{bands}
<IMAGE><SATID>WV03</SATID><FIRSTLINETIME>{shot.time:%Y-%m-%dT%H:%M:%S}.000000Z</FIRSTLINETIME>
<MEANSUNAZ>{SUN_AZIMUTH}</MEANSUNAZ><MEANSUNEL>{SUN_ELEVATION}</MEANSUNEL><MEANSATAZ>{VIEW_AZIMUTH}</MEANSATAZ>
<MEANSATEL>{VIEW_ELEVATION}</MEANSATEL><MEANOFFNADIRVIEWANGLE>{OFF_NADIR}</MEANOFFNADIRVIEWANGLE>
<CLOUDCOVER>{CLOUD}</CLOUDCOVER></IMAGE></IMD>
<RPB><SATID>WV03</SATID><SPECID>RPC00B</SPECID><IMAGE><ERRBIAS>0.3</ERRBIAS>{scalars}{terms}</IMAGE></RPB></isd>
"""


def geoeye_delivery(root: Path, taken: list[Shot]) -> Path:
    """Products of GeoEye itself: pan and bgrn of each shot, and one text of metadata."""
    root.mkdir(parents=True)
    sections = []
    for number, shot in enumerate(taken):
        for kind, pixels, rpc in (("pan", shot.grey, shot.rpc), ("bgrn", shot.bands("BGRN"), shot.colour_rpc)):
            write_image(root / f"po_1234567_{kind}_{number:03}0000.tif", pixels)
            (root / f"po_1234567_{kind}_{number:03}0000_rpc.txt").write_text(rpc_txt(rpc))
        sections.append(
            f"Source Image ID: 20141005160{number}\nProduct Image ID: {number:03}\nSensor: GeoEye-1\n"
            f"Nominal Collection Azimuth: {VIEW_AZIMUTH} degrees\n"
            f"Nominal Collection Elevation: {VIEW_ELEVATION} degrees\n"
            f"Sun Angle Azimuth: {SUN_AZIMUTH} degrees\nSun Angle Elevation: {SUN_ELEVATION} degrees\n"
            f"Acquisition Date/Time: {shot.time:%Y-%m-%d %H:%M:%S} GMT\nPercent Cloud Cover: {100 * CLOUD:.0f}\n"
        )
    ruler = "=" * 40
    (root / "po_1234567_metadata.txt").write_text(
        f"Product Order Metadata\nCreation Date: 2014-11-01\nSensor Name: GeoEye-1\n{ruler}\nSource Image Metadata\n"
        f"Number of Source Images: {len(taken)}\n" + "\n".join(sections) + f"{ruler}\nProduct Component Metadata\n"
    )
    return root


def planet_delivery(root: Path, taken: list[Shot]) -> Path:
    """SkySat scenes: basic panchromatic and analytic images, unusable data masks, and metadata."""
    root.mkdir(parents=True)
    for shot in taken:
        scene = f"{shot.time:%Y%m%d_%H%M%S}_ssc2d1_{shot.name}"
        for kind, pixels, rpc in (
            ("panchromatic_dn", shot.grey, shot.rpc), ("analytic_dn", shot.bands("BGRN"), shot.colour_rpc),
        ):  # fmt: skip
            write_image(root / f"{scene}_basic_{kind}.tif", pixels)
            (root / f"{scene}_basic_{kind}_RPC.TXT").write_text(rpc_txt(rpc))
        write_udm2(root / f"{scene}_basic_panchromatic_udm2.tif", shot.is_cloudy)
        properties = {
            "acquired": f"{shot.time:%Y-%m-%dT%H:%M:%S}.000000Z", "sun_azimuth": SUN_AZIMUTH,
            "sun_elevation": SUN_ELEVATION, "satellite_azimuth": VIEW_AZIMUTH, "view_angle": OFF_NADIR,
            "cloud_cover": CLOUD, "satellite_id": "SSC2", "item_type": "SkySatScene",
        }  # fmt: skip
        document = {"type": "Feature", "id": scene, "properties": properties, "geometry": None}
        (root / f"{scene}_metadata.json").write_text(json.dumps(document))
    return root


def write_udm2(path: Path, is_cloudy: NDArray[np.bool_]) -> None:
    """An unusable data mask of eight bands, that calls some pixels (r, c) cloud and all others clear."""
    bands = np.zeros((8, *is_cloudy.shape), np.uint8)
    bands[0], bands[5], bands[6] = ~is_cloudy, is_cloudy, 100
    write_image(path, bands)


def gaofen_delivery(root: Path, taken: list[Shot], zenith: float = 90 - SUN_ELEVATION) -> Path:
    """GaoFen-2 scenes: PAN and MSS as .tiff, each with an .rpb and an .xml of its name.

    zenith : what the XML calls the zenith angle of the sun.
    """
    for shot in taken:
        scene = f"GF2_PMS1_E5.2_N47.4_{shot.time:%Y%m%d}_L1A{shot.name}"
        folder = root / scene
        folder.mkdir(parents=True)
        local = shot.time + datetime.timedelta(hours=8)
        for kind, pixels, rpc in (("PAN1", shot.grey, shot.rpc), ("MSS1", shot.bands("BGRN"), shot.colour_rpc)):
            write_image(folder / f"{scene}-{kind}.tiff", pixels)
            (folder / f"{scene}-{kind}.rpb").write_text(rpb(rpc))
            (folder / f"{scene}-{kind}.xml").write_text(
                f"""<?xml version="1.0" encoding="UTF-8"?>
<ProductMetaData><SatelliteID>GF2</SatelliteID><SensorID>PMS1</SensorID>
<ReceiveTime>{shot.time:%Y-%m-%d %H:%M:%S}</ReceiveTime><StartTime>{local:%Y-%m-%d %H:%M:%S}</StartTime>
<WidthInPixels>{pixels.shape[-1]}</WidthInPixels><HeightInPixels>{pixels.shape[-2]}</HeightInPixels>
<SolarAzimuth>{SUN_AZIMUTH}</SolarAzimuth><SolarZenith>{zenith}</SolarZenith>
<CenterLatitude>30.35</CenterLatitude><CenterLongitude>-81.66</CenterLongitude>
<SatelliteAzimuth>{VIEW_AZIMUTH}</SatelliteAzimuth><SatelliteZenith>{90 - VIEW_ELEVATION}</SatelliteZenith>
<CloudPercent>{100 * CLOUD}</CloudPercent></ProductMetaData>
"""
            )
    return root


def nitf_delivery(root: Path, taken: list[Shot]) -> Path:
    """NITF files with RPC00B in their headers."""
    root.mkdir(parents=True)
    for shot in taken:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(
                root / f"{shot.name}.ntf", "w", driver="NITF", dtype="uint16", count=1, height=shot.grey.shape[0],
                width=shot.grey.shape[1], rpcs=gdal_rpc(shot.rpc), IDATIM=f"{shot.time:%Y%m%d%H%M%S}",
            ) as file:  # fmt: skip
                file.write(shot.grey, 1)
    return root


def stac_delivery(root: Path, taken: list[Shot], version: str = "1.0.0") -> Path:
    """A catalogue with an item for each shot; returns the path of the catalogue."""
    root.mkdir(parents=True)
    links = []
    for shot in taken:
        folder = root / "items" / shot.name
        folder.mkdir(parents=True)
        for kind, pixels, rpc in (("pan", shot.grey, shot.rpc), ("ms", shot.bands("BGRN"), shot.colour_rpc)):
            write_image(folder / f"{kind}.tif", pixels)
            (folder / f"{kind}_RPC.TXT").write_text(rpc_txt(rpc))
        names = ("blue", "green", "red", "nir")
        assets = {
            "pan": {
                "href": "./pan.tif", "type": "image/tiff; application=geotiff", "roles": ["data"],
                "eo:bands": [{"name": "P", "common_name": "pan"}],
            },
            "ms": {
                "href": "./ms.tif", "type": "image/tiff; application=geotiff", "roles": ["data"],
                "eo:bands": [{"name": name, "common_name": name} for name in names],
            },
            "thumbnail": {"href": "./none.png", "type": "image/png", "roles": ["thumbnail"]},
        }  # fmt: skip
        properties = {
            "datetime": f"{shot.time:%Y-%m-%dT%H:%M:%S}Z", "platform": "WV03", "view:sun_azimuth": SUN_AZIMUTH,
            "view:sun_elevation": SUN_ELEVATION, "view:azimuth": VIEW_AZIMUTH, "view:off_nadir": OFF_NADIR,
            "view:incidence_angle": 90 - VIEW_ELEVATION, "eo:cloud_cover": 100 * CLOUD,
        }  # fmt: skip
        item = {
            "type": "Feature", "stac_version": version, "id": shot.name, "geometry": None, "properties": properties,
            "links": [{"rel": "root", "href": "../../catalog.json"}], "assets": assets,
        }  # fmt: skip
        (folder / "item.json").write_text(json.dumps(item))
        links.append({"rel": "item", "href": f"./items/{shot.name}/item.json"})
    catalogue = {"type": "Catalog", "stac_version": version, "id": "c", "description": "", "links": links}
    (root / "catalog.json").write_text(json.dumps(catalogue))
    return root / "catalog.json"


def zipped(folder: Path, archive: Path, compression: int = zipfile.ZIP_DEFLATED) -> Path:
    """A ZIP of all files of a folder, under its name."""
    with zipfile.ZipFile(archive, "w", compression) as file:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                file.write(path, path.relative_to(folder.parent).as_posix())
    return archive
