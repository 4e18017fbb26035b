"""Where networks are kept that were made before, and whether one is still as it was made."""

import hashlib
import os
from pathlib import Path

import platformdirs

from unjam.errors import wrong
from unjam.sumo_files import stamp_of

_whole: dict[Path, tuple[int, int]] = {}
"""networks in the cache that this process has found whole, with their stamps"""


def cache_folder() -> Path:
    """Return where networks are kept: `$UNJAM_CACHE`, or the user's cache folder.

    Raises:
        InputError: SUMO would take its name for a list, or for a variable.
    """
    chosen = os.environ.get("UNJAM_CACHE") or platformdirs.user_cache_dir("unjam")
    if any(sign in chosen for sign in ",;$%"):
        raise wrong("UNJAM_CACHE", chosen, "a folder without , ; $ % in its name")
    return Path(chosen)


def seal(content: bytes) -> bytes:
    """Return the last line of a network in the cache: the hash of what is before it."""
    return f"<!-- sha256 {hashlib.sha256(content).hexdigest()} -->\n".encode()


def is_as_made(network: Path) -> bool:
    """Return whether a network in the cache is there, and nobody has changed or cut it since it was made."""
    try:
        stamp = stamp_of(network)
        if _whole.get(network) != stamp:
            content = network.read_bytes()
            length = len(content) - len(seal(b""))
            if content[length:] != seal(content[:length]):
                return False
            _whole[network] = stamp
    except OSError:
        return False
    return True
