"""A scene for 3D Slicer: surface files with their names, colours and frame; knows no anatomy.

Slicer takes a model of a scene that states no coordinate system to be RAS, and a model file by itself to be LPS unless
it says otherwise (``SPACE``); so both are always stated here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from urllib.parse import quote
from xml.sax.saxutils import quoteattr

from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame

_NOT_XML = dict.fromkeys((*range(9), 11, 12, *range(14, 32), 65534, 65535))
"""Characters that XML 1.0 cannot hold."""


@dataclass(frozen=True, slots=True)
class SceneModel:
    """A surface of a scene.

    Parameters
    ----------
    name : str
    file : str
        Its path below the scene's folder, with /.
    colour : tuple of three float, 0 to 1
    opacity : float, 0 to 1
    """

    name: str
    file: str
    colour: tuple[float, float, float]
    opacity: float = 1.0


def scene_text(models: Sequence[SceneModel], *, frame: Frame) -> str:
    """The text of a .mrml file that Slicer opens with all its models, in their colours.

    Raises
    ------
    InputError
        No model.
    """
    if not models:
        raise InputError("a scene without a model cannot be opened; give at least one surface")
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<MRML version="Slicer5.0.0" userTags="">']
    for number, model in enumerate(models, start=1):
        lines += _nodes(model, number, frame)
    return "\n".join([*lines, "</MRML>", ""])


def _nodes(model: SceneModel, number: int, frame: Frame) -> Iterator[str]:
    storage, display = f"vtkMRMLModelStorageNode{number}", f"vtkMRMLModelDisplayNode{number}"
    name = quoteattr(model.name.translate(_NOT_XML))
    colour = " ".join(f"{part:.6g}" for part in model.colour)
    yield (
        f'  <ModelStorage id="{storage}" name={name} fileName="{quote(model.file)}" '
        f'coordinateSystem="{frame.value.upper()}"></ModelStorage>'
    )
    yield (
        f'  <ModelDisplay id="{display}" name={name} color="{colour}" opacity="{model.opacity:.6g}" visibility="true" '
        'scalarVisibility="false" backfaceCulling="false"></ModelDisplay>'
    )
    yield (
        f'  <Model id="vtkMRMLModelNode{number}" name={name} references="display:{display};storage:{storage};"></Model>'
    )
