"""Which arm of which file is meant: the options of every command that takes `--model`.

Imported by the command line before numpy is, so it needs neither numpy nor JAX.
"""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import InputError


@dataclasses.dataclass(frozen=True)
class Part:
    """What is meant of a model, where it holds more than one serial arm."""

    root: str = ""
    """Body of the model that the arm stands on, where that moves or carries more than one arm: it is held where
    the file has it, and the arm is what moves beyond it."""
    tip: str = ""
    """Last body of the arm, where it branches or the model holds more than one: what moves beyond it, or beside
    the way to it, is locked and counts to the link that carries it."""
    outside: bool = False
    """Follow includes, meshes and attached models to outside of the model's folder."""

    def of(self, model: Path) -> "ModelFile":
        """That part of this file."""
        return ModelFile(model, self)

    def of_any(self, model: Path | None) -> "ModelFile | None":
        """The same, without a file too, of which nothing can be chosen.

        Raises:
            InputError: something is chosen of no file.
        """
        if model is None and self != WHOLE:
            option = "--root" if self.root else "--tip" if self.tip else "--outside"
            raise InputError(f"{option}: is about a model; give its file by --model")
        return None if model is None else ModelFile(model, self)

    def to_json(self) -> dict[str, Any] | None:
        """None where nothing is chosen."""
        return None if self == WHOLE else dataclasses.asdict(self)

    @classmethod
    def from_json(cls, document: Mapping[str, Any] | None) -> "Part":
        """The inverse of `to_json`; what is none raises TypeError or ValueError."""
        part = cls(**(document or {}))
        if not (isinstance(part.root, str) and isinstance(part.tip, str) and isinstance(part.outside, bool)):
            raise ValueError("model_part must hold the names of two bodies and whether files outside count")
        return part


WHOLE = Part()
"""The model's only arm."""


@dataclasses.dataclass(frozen=True)
class ModelFile(os.PathLike[str]):
    """An MJCF or URDF, and which arm of it is meant; goes wherever the path of a model does.

    jaxpanda.diagnose(jaxpanda.ModelFile("scene.xml", jaxpanda.Part(root="left/base_link")), ["left.csv"])
    """

    path: str | Path
    part: Part = WHOLE

    def __fspath__(self) -> str:
        return os.fspath(self.path)

    def __str__(self) -> str:
        return str(self.path)


Model = str | Path | ModelFile
"""How a model is named: by its path, or with the arm that is meant of it."""


def part_of(model: Model) -> Part:
    return model.part if isinstance(model, ModelFile) else WHOLE
