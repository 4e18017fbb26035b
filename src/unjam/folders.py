"""Folders that are reached without following links which a stranger may have planted in them.

Links on the way to a folder that the user names are the user's own choice. Inside a folder that a process
holds (`protect_folder`) none is followed: each part of a path is opened from the handle of the one before.
Where the system has no such handles (Windows), paths are looked at before they are used.
"""

import json
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from unjam.errors import DiskError, InputError

PROTECTED_FOLDERS_VARIABLE = "UNJAM_PROTECTED_FOLDERS"
"""the variable that tells a child process which folders are held by the processes that started it"""
NO_FOLLOW_FLAGS = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"))
"""flags of `os.open`: follow no link, and wait for no pipe; not every system has all of them"""
FOLDER_FLAGS = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0)
_protected: list[Path] = []


class Folder:
    """An open folder, whose entries are named relative to its handle."""

    def __init__(self, path: Path, handle: int | None) -> None:
        """Take the folder's handle; None where the system has no such handles."""
        self.path, self.handle = path, handle

    def entry_path(self, name: str) -> str:
        """Return the name of an entry as system calls take it, beside `dir_fd`."""
        return name if self.handle is not None else str(self.path / name)

    def mode(self, name: str) -> int:
        """Return the mode of an entry, of a link its own; 0 where there is none."""
        try:
            return os.stat(self.entry_path(name), dir_fd=self.handle, follow_symlinks=False).st_mode
        except FileNotFoundError:
            return 0

    def check_writable(self, name: str) -> None:
        """Raise `InputError` where an entry is a link, `DiskError` where it is something else than a file."""
        if stat.S_ISLNK(mode := self.mode(name)):
            raise link_error(self.path / name)
        if mode and not stat.S_ISREG(mode):
            raise DiskError(f"cannot write {_short_path(self.path / name)}: it is no file")

    def open(self, name: str, flags: int, mode: int = 0o666) -> int:
        """Open a file that is not a link, as `os.open` does, and return its descriptor."""
        return os.open(self.entry_path(name), flags | NO_FOLLOW_FLAGS, mode, dir_fd=self.handle)

    def create(self, name: str, mode: int = 0o666) -> int:
        """Open a new file for writing; raise `FileExistsError` where there is an entry of that name."""
        return self.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)

    def make_subfolder(self, name: str) -> None:
        """Make a folder in this one; raise `FileExistsError` where there is an entry of that name."""
        os.mkdir(self.entry_path(name), dir_fd=self.handle)

    @contextmanager
    def enter(self, name: str) -> Iterator["Folder"]:
        """Open a folder in this one; raise `InputError` where it is a link, or leads out."""
        if name == ".." or stat.S_ISLNK(self.mode(name)):
            raise link_error(self.path / name)
        with _open_by_name(self.path / name, name, self.handle) as inner:
            yield inner

    def rename(self, source: str, target: str) -> None:
        """Rename an entry, in place of any other file of that name; the disk has it when this returns."""
        os.replace(self.entry_path(source), self.entry_path(target), src_dir_fd=self.handle, dst_dir_fd=self.handle)
        self.sync()

    def remove(self, name: str) -> None:
        """Remove a file, or a folder with everything in it; of a link the link itself."""
        if stat.S_ISDIR(self.mode(name)):
            shutil.rmtree(self.entry_path(name), dir_fd=self.handle)
        else:
            os.unlink(self.entry_path(name), dir_fd=self.handle)

    def sync(self) -> None:
        """Let the disk keep the names of the entries; on Windows the system does so by itself."""
        if self.handle is not None:
            os.fsync(self.handle)


@contextmanager
def _open_by_name(path: Path, name: Path | str, parent: int | None) -> Iterator[Folder]:
    """Open a folder by its name in the open folder `above`, or by its path where that is None."""
    if os.open not in os.supports_dir_fd:
        yield Folder(path, None)
        return
    handle = os.open(name, FOLDER_FLAGS | (0 if parent is None else NO_FOLLOW_FLAGS), dir_fd=parent)
    try:
        yield Folder(path, handle)
    finally:
        os.close(handle)


@contextmanager
def open_folder(path: Path, make: bool = False) -> Iterator[Folder]:
    """Open a folder, following links to a folder that is held, or to any other, but none inside a held one.

    With `make` what is missing inside a held folder is made.

    Raises:
        InputError: inside a held folder the path leads through a link, or out again.
        OSError: it cannot be opened.
    """
    path = path.absolute()
    root = protected_root(path)
    with ExitStack() as stack:
        folder = stack.enter_context(_open_by_name(root, root, None))
        for name in path.relative_to(root).parts:
            if make:
                with suppress(FileExistsError):
                    folder.make_subfolder(name)
            folder = stack.enter_context(folder.enter(name))
        yield folder


def protected_root(path: Path) -> Path:
    """Return the outermost held folder that contains an absolute path; the path itself where none does."""
    around = [root for root in protected_folders() if path.is_relative_to(root)]
    return min(around, key=lambda root: len(root.parts), default=path)


def protected_folders() -> list[Path]:
    """Return the folders that this process holds, and those that the processes hold that started it."""
    return [*map(Path, json.loads(os.environ.get(PROTECTED_FOLDERS_VARIABLE, "[]"))), *_protected]


@contextmanager
def protect_folder(folder: Path) -> Iterator[None]:
    """Hold a folder: inside it no link is followed while the block runs.

    Raises:
        InputError: one of its entries is a link.
    """
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_symlink():
                raise link_error(folder / entry.name)
    root = folder.absolute()
    _protected.append(root)
    try:
        yield
    finally:
        _protected.remove(root)


def link_error(path: Path) -> InputError:
    """Return the error for a path on which a link, or `..`, leads out of a folder."""
    why = "is a symbolic link or leads out of its folder, so nothing is written there"
    return InputError(f"file: {_short_path(path)!r} {why}; allowed: a file or folder itself, or a new name")


def _short_path(path: Path) -> str:
    """Return a path as short as it is clear: relative to the working folder where it is inside."""
    here = Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)
