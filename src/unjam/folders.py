"""Open folders without following links that another person may have placed in them.

Links in the path of a folder that the user names are followed. Inside a protected folder no link is followed: each
folder of a path is opened relative to the handle of its parent; on Windows it is only checked before.
"""

import json
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from unjam.errors import DiskError, InputError

PROTECTED_FOLDERS_VARIABLE = "UNJAM_PROTECTED_FOLDERS"  # variable with the folders of parent processes
NO_FOLLOW_FLAGS = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"))
"""flags of `os.open`: follow no link, and do not wait for a pipe; some systems lack some of the flags"""
FOLDER_FLAGS = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0)
_protected: list[Path] = []


class Folder:
    """An open folder; entries are opened relative to `handle`, or by path if the system has no such handles."""

    def __init__(self, path: Path, handle: int | None) -> None:
        self.path, self.handle = path, handle

    def entry_path(self, name: str) -> str:
        """Return the name of an entry relative to `handle`, for a system call with `dir_fd`, or else its path."""
        return name if self.handle is not None else str(self.path / name)

    def mode(self, name: str) -> int:
        """Return the mode of an entry, of a link instead of its target; 0: there is no such entry."""
        try:
            return os.stat(self.entry_path(name), dir_fd=self.handle, follow_symlinks=False).st_mode
        except FileNotFoundError:
            return 0

    def check_writable(self, name: str) -> None:
        """Raise `InputError` if an entry is a link, `DiskError` if it is not a regular file."""
        if stat.S_ISLNK(mode := self.mode(name)):
            raise link_error(self.path / name)
        if mode and not stat.S_ISREG(mode):
            raise DiskError(f"cannot write {_short_path(self.path / name)}: it is not a file")

    def open(self, name: str, flags: int, mode: int = 0o666) -> int:
        """Open a file that is not a link, as `os.open` does, and return its descriptor."""
        return os.open(self.entry_path(name), flags | NO_FOLLOW_FLAGS, mode, dir_fd=self.handle)

    def create(self, name: str, mode: int = 0o666) -> int:
        """Open a new file for writing; raise `FileExistsError` if an entry has that name."""
        return self.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)

    @contextmanager
    def enter(self, name: str) -> Iterator["Folder"]:
        """Open a subfolder; raise `InputError` if it is a link or `..`."""
        if name == ".." or stat.S_ISLNK(self.mode(name)):
            raise link_error(self.path / name)
        with _open_by_name(self.path / name, name, self.handle) as subfolder:
            yield subfolder

    def rename(self, source: str, target: str) -> None:
        """Rename an entry, replace the file named `target` if it exists, and sync the folder to the disk."""
        os.replace(self.entry_path(source), self.entry_path(target), src_dir_fd=self.handle, dst_dir_fd=self.handle)
        self.sync()

    def remove(self, name: str) -> None:
        """Remove a file, a link itself, or a folder with its content."""
        if stat.S_ISDIR(self.mode(name)):
            shutil.rmtree(self.entry_path(name), dir_fd=self.handle)
        else:
            os.unlink(self.entry_path(name), dir_fd=self.handle)

    def sync(self) -> None:
        """Sync the names of the entries to the disk; Windows does this itself."""
        if self.handle is not None:
            os.fsync(self.handle)


@contextmanager
def _open_by_name(path: Path, name: Path | str, parent: int | None) -> Iterator[Folder]:
    """Open a folder by its `name` in the folder with the handle `parent`; None: `name` is a path."""
    if os.open not in os.supports_dir_fd:
        yield Folder(path, None)
        return
    handle = os.open(name, FOLDER_FLAGS | (0 if parent is None else NO_FOLLOW_FLAGS), dir_fd=parent)
    try:
        yield Folder(path, handle)
    finally:
        os.close(handle)


@contextmanager
def open_folder(path: Path, create: bool = False) -> Iterator[Folder]:
    """Open a folder, or `create` a protected one; raise `InputError` for links or `..` inside a protected folder."""
    path = path.absolute()
    root = protected_root(path)
    with ExitStack() as stack:
        folder = stack.enter_context(_open_by_name(root, root, None))
        for name in path.relative_to(root).parts:
            if create:
                with suppress(FileExistsError):
                    os.mkdir(folder.entry_path(name), dir_fd=folder.handle)
            folder = stack.enter_context(folder.enter(name))
        yield folder


def protected_root(path: Path) -> Path:
    """Return the outermost protected folder that contains an absolute path, or else the path itself."""
    roots = [root for root in protected_folders() if path.is_relative_to(root)]
    return min(roots, key=lambda root: len(root.parts), default=path)


def protected_folders() -> list[Path]:
    """Return the folders that this process and its parent processes protect."""
    return [*map(Path, json.loads(os.environ.get(PROTECTED_FOLDERS_VARIABLE, "[]"))), *_protected]


@contextmanager
def protect_folder(folder: Path) -> Iterator[None]:
    """Follow no links inside a folder within the block; raise `InputError` if an entry of the folder is a link."""
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


def reject_unsafe_files(folder: Path) -> None:
    """Raise `InputError` if a folder contains a file that must not be read.

    Reading a pipe, a socket or a device could wait forever. A link could copy a secret from elsewhere into a report.
    """
    root = os.path.realpath(folder)
    for parent, subfolders, names in os.walk(folder):
        for path in (Path(parent) / name for name in (*subfolders, *names)):
            if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(root):
                raise InputError(f"file: {_short_path(path)!r} is a link out of its folder; allowed: the file itself")
            with suppress(OSError):  # the link is broken, or the file was removed meanwhile
                mode = path.stat().st_mode
                if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
                    raise InputError(f"file: {_short_path(path)!r} is a special file; allowed: regular files")


def link_error(path: Path) -> InputError:
    """Return the error for a path that leads out of a folder through a link or `..`."""
    reason = "is a symbolic link or leads out of its folder, so nothing is written there"
    return InputError(f"file: {_short_path(path)!r} {reason}; allowed: a file or folder itself, or a new name")


def _short_path(path: Path) -> str:
    """Return a path inside the working folder relative to it, and other paths unchanged."""
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)
