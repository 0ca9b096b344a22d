"""The plugin of QGIS: algorithms that run the command zlocus."""

from __future__ import annotations

from typing import Any


def classFactory(iface: Any) -> Any:
    """The plugin, as QGIS asks for it. iface : of the window of QGIS, None without one."""
    from .plugin import ZlocusPlugin

    return ZlocusPlugin()
