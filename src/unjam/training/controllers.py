"""The controllers of a run: those in its folders, and those that a longer run goes on from."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch

from unjam.files import make_folder, write_whole

if TYPE_CHECKING:
    from unjam.learners.learner import Tensors

Kind = Literal["best", "kept"]


class KeptControllers:
    """The content of the controllers that are in a run's folders.

    `best` are those of validations that a longer run makes too; `kept` also those of its last iteration.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        """Prepare for one controller in each of the folders."""
        self._folders = folders
        self._contents: dict[Kind, list[bytes]] = {}

    def keep(self, contents: list[bytes], best: bool) -> None:
        """Write a controller into each folder."""
        self._contents |= {"kept": contents, **({"best": contents} if best else {})}
        self._write("kept")

    def tensors(self) -> "Tensors":
        """Return all of them for a checkpoint."""
        return {
            f"{kind}/{index}": torch.frombuffer(bytearray(content), dtype=torch.uint8)
            for kind, contents in self._contents.items()
            for index, content in enumerate(contents)
        }

    def restore(self, tensors: "Tensors", ended: bool) -> None:
        """Take those of a checkpoint out of `tensors`, and write them: `kept` where the training has ended.

        What was in the folders may be of a later iteration, or somebody else's.
        """
        for kind in ("best", "kept") if "best/0" in tensors else ():
            found = [tensors.pop(f"{kind}/{index}") for index in range(len(self._folders))]
            self._contents[kind] = [each.numpy().tobytes() for each in found]
        if not ended and "best" in self._contents:
            self._contents["kept"] = self._contents["best"]
        self._write("kept")

    def _write(self, kind: Kind) -> None:
        for folder, content in zip(self._folders, self._contents.get(kind, ()), strict=False):
            make_folder(folder)
            write_whole(folder / "controller.unjam", content)
