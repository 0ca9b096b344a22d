"""Read the RPC from the image support data that Maxar delivers as XML (`<isd>` with a part `<RPB>`).

The names of its elements are those of `.RPB` in capital letters, and it counts pixels in the same way. Newer files have
a namespace, and a list of numbers in one element (`LINENUMCOEFList/LINENUMCOEF`).

Source: DigitalGlobe, Imagery Support Data Documentation (2014).
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

from zlocus.core.errors import InputError
from zlocus.io.cameras.rpc_text import RPB_NAMES, RpcFields, rpc_from_fields
from zlocus.io.safe_text import EXPORT_AGAIN
from zlocus.io.vendor_xml import leaves, plain_xml
from zlocus.sensors.rpc import RpcCoefficients

ROOT = "isd"
FIELD_OF = {name.lower(): field for name, field in RPB_NAMES.items()}


def is_isd(root: Element) -> bool:
    """Whether a document without namespaces is image support data."""
    return root.tag.lower() == ROOT


def read_isd_rpc(path: Path) -> RpcCoefficients:
    """The RPC of a file of image support data.

    Raises
    ------
    InputError
        It has none, or a damaged one.
    """
    part = plain_xml(path).find("RPB")
    if part is None:
        raise InputError(f"{path} has no part RPB with an RPC. {EXPORT_AGAIN}")
    kind = part.findtext("SPECID")
    if kind is not None and kind.strip().upper() != "RPC00B":
        raise InputError(f"{path} is an {kind.strip()} model, of another term order. Only RPC00B is read; convert it.")
    fields = RpcFields(path)
    for name, text in leaves(part):
        if name in FIELD_OF:
            fields.add(FIELD_OF[name], text)
    return rpc_from_fields(fields, path)
