"""Results as layers of the project: with their styles, in one group, in an order in which they can be read."""

from __future__ import annotations

import os
from typing import Any, Sequence

from qgis.core import QgsMapLayer, QgsProcessingContext, QgsProcessingFeedback, QgsProcessingLayerPostProcessorInterface

from .results import ShownFile

# QGIS does not keep the objects that finish a layer after an algorithm has ended.
_kept: list[StyledLayer] = []
RANK = "zlocus/rank"


class StyledLayer(QgsProcessingLayerPostProcessorInterface):
    """Gives a layer its style, and its place in the group of its result, which QGIS before 3.32 does not know."""

    def __init__(self, style: str, group: str, rank: int, is_visible: bool) -> None:
        super().__init__()
        self._style, self._group, self._rank, self._is_visible = style, group, rank, is_visible

    def postProcessLayer(
        self, layer: QgsMapLayer, context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> None:
        """Finish a layer, as QGIS asks for it."""
        if os.path.isfile(self._style):
            layer.loadNamedStyle(self._style)
            layer.triggerRepaint()
        layer.setCustomProperty(RANK, self._rank)
        root = context.project().layerTreeRoot() if context.project() is not None else None
        node = root.findLayer(layer.id()) if root is not None else None
        if node is None:
            return
        node.setItemVisibilityChecked(self._is_visible)
        node.setExpanded(False)
        group = root.findGroup(self._group) or root.insertGroup(0, self._group)
        others = [each for each in group.findLayers() if each.layerId() != layer.id()]
        moved = node.clone()
        node.parent().removeChildNode(node)
        below = [k for k, each in enumerate(others) if _rank(each) > self._rank]
        group.insertChildNode(below[0] if below else -1, moved)


def _rank(node: Any) -> int:
    layer = node.layer()
    return int(layer.customProperty(RANK, 0)) if layer is not None else 0


def load_on_completion(context: QgsProcessingContext, folder: str, files: Sequence[ShownFile]) -> None:
    """Let files of a folder become layers of the project once the algorithm has ended."""
    project = context.project()
    if project is None:
        return
    group = f"zlocus {os.path.basename(os.path.normpath(folder))}"
    for rank, shown in enumerate(files):
        path = os.path.join(folder, shown.name)
        details = QgsProcessingContext.LayerDetails(shown.title, project, shown.name)
        details.forceName = True
        if hasattr(details, "groupName"):  # from QGIS 3.32 on
            details.groupName, details.layerSortKey = group, len(files) - rank
        finisher = StyledLayer(os.path.join(folder, shown.style), group, rank, shown.is_visible)
        _kept.append(finisher)
        details.setPostProcessor(finisher)
        context.addLayerToLoadOnCompletion(path, details)
