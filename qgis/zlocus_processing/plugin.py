"""The plugin, with and without a window of QGIS."""

from __future__ import annotations

from qgis.core import QgsApplication

from .provider import ZlocusProvider


class ZlocusPlugin:
    """Adds the provider to the toolbox of Processing, and takes it away."""

    def __init__(self) -> None:
        self._provider: ZlocusProvider | None = None

    def initProcessing(self) -> None:
        """Add the provider, as `qgis_process` asks for it."""
        self._provider = ZlocusProvider()
        QgsApplication.processingRegistry().addProvider(self._provider)

    def initGui(self) -> None:
        """Begin, as QGIS asks for it."""
        self.initProcessing()

    def unload(self) -> None:
        """End, as QGIS asks for it."""
        if self._provider is not None:
            QgsApplication.processingRegistry().removeProvider(self._provider)
