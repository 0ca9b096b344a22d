"""The provider of Processing: its algorithms, and the path of the command as its setting."""

from __future__ import annotations

import os

from processing.core.ProcessingConfig import ProcessingConfig, Setting
from qgis.core import QgsProcessingProvider
from qgis.PyQt.QtGui import QIcon

from .algorithm import COMMAND_SETTING
from .compare import Compare
from .evaluate import Evaluate
from .make_surface import MakeSurface
from .products import Products

FOLDER = os.path.dirname(__file__)


class ZlocusProvider(QgsProcessingProvider):
    """The algorithms that run the command zlocus."""

    def id(self) -> str:
        return "zlocus"

    def name(self) -> str:
        return "zlocus"

    def longName(self) -> str:
        return "zlocus: digital surface models from images"

    def icon(self) -> QIcon:
        return QIcon(os.path.join(FOLDER, "icon.svg"))

    def load(self) -> bool:
        """Add the setting, and the algorithms."""
        ProcessingConfig.settingIcons[self.name()] = self.icon()
        described = "Path of the command zlocus (empty: the one on PATH)"
        ProcessingConfig.addSetting(Setting(self.name(), COMMAND_SETTING, described, "", valuetype=Setting.FILE))
        ProcessingConfig.readSettings()
        self.refreshAlgorithms()
        return True

    def unload(self) -> None:
        ProcessingConfig.removeSetting(COMMAND_SETTING)

    def loadAlgorithms(self) -> None:
        for algorithm in (MakeSurface, Evaluate, Products, Compare):
            self.addAlgorithm(algorithm())
