import errno
import os
import resource
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree

import numpy as np
import platformdirs
import pytest

from unjam import files
from unjam.errors import DiskError, EpisodeError, MissingPartError, as_unjam_error
from unjam.files import is_leftover
from unjam.scenarios import Ring
from unjam.scenarios.road import RoadNetwork
from unjam.worlds.sumo import networks
from unjam.worlds.sumo.example_roads import write_example_road
from unjam.worlds.sumo.networks import cache_folder, network_file, sumo_program


def road_of(length: int) -> RoadNetwork:
    return Ring(length=(length, length)).draw(np.random.default_rng(0)).network


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv("UNJAM_CACHE", str(folder))
    return folder


@pytest.fixture
def no_sumo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr("sumo.SUMO_HOME", str(tmp_path / "nowhere"))
    monkeypatch.setenv("PATH", str(tmp_path))
    sumo_program.cache_clear()
    yield
    sumo_program.cache_clear()


def refuse_to_run(*arguments: Any, **options: Any) -> NoReturn:
    raise AssertionError("netconvert was run")


def files_in(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file() or not any(path.iterdir())}


def edges_of(path: Path) -> dict[str, float]:
    """Length of each edge in one of SUMO's network files; an error where the file is not whole."""
    edges = ElementTree.parse(path).getroot().findall("edge")
    return {edge.attrib["id"]: float(edge.find("lane").attrib["length"]) for edge in edges}  # pyright: ignore


def test_the_network_has_the_roads_edges_and_no_others(cache: Path) -> None:
    assert edges_of(network_file(road_of(230))) == {f"edge_{index}": 57.5 for index in range(4)}


def test_a_road_made_before_is_not_made_again(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = network_file(road_of(230))
    monkeypatch.setattr(subprocess, "run", refuse_to_run)
    assert network_file(road_of(230)) == made
    with pytest.raises(AssertionError, match="netconvert was run"):
        network_file(road_of(231))


def test_other_traffic_on_the_same_road_needs_no_other_network(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = network_file(road_of(230))
    monkeypatch.setattr(subprocess, "run", refuse_to_run)
    other = Ring(length=(230, 230), vehicles=11, cavs=3).draw(np.random.default_rng(1))
    assert network_file(other.network) == made


def test_every_change_of_a_network_makes_another_file(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    road = road_of(230)
    other = road_of(240)
    plain = tuple(node._replace(has_priority=False) for node in road.nodes)
    changed = (
        road,
        other,
        replace(road, speed_limit=20.0),
        replace(road, nodes=plain),
        replace(road, has_internal_links=True),
    )
    made = [network_file(each) for each in changed]
    monkeypatch.setattr(networks, "sumo_version", lambda: "9.99.0")
    made.append(network_file(road))
    assert len(set(made)) == 6
    assert edges_of(made[0]) != edges_of(made[1])
    assert files_in(cache) == set(made)


def test_the_user_can_choose_the_cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNJAM_CACHE", str(tmp_path / "mine"))
    assert network_file(road_of(230)).is_relative_to(tmp_path / "mine")
    monkeypatch.setenv("UNJAM_CACHE", str(tmp_path / "other"))
    assert network_file(road_of(230)).is_relative_to(tmp_path / "other")


@pytest.mark.parametrize("value", [None, ""])
def test_the_default_cache_folder_is_the_systems(value: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("UNJAM_CACHE", raising=False)
    if value is not None:
        monkeypatch.setenv("UNJAM_CACHE", value)
    assert cache_folder() == Path(platformdirs.user_cache_dir("unjam"))


def test_threads_that_make_the_same_network_get_one_complete_file(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = network_file(road_of(250))
    edges = edges_of(expected)
    expected.unlink()
    there_too_early = []
    run, together = subprocess.run, threading.Barrier(3, timeout=60)

    def run_together(*arguments: Any, **options: Any) -> Any:
        done = run(*arguments, **options)
        there_too_early.append(expected.exists())
        together.wait()
        return done

    monkeypatch.setattr(subprocess, "run", run_together)
    with ThreadPoolExecutor(3) as threads:
        made = [threads.submit(network_file, road_of(250)) for _ in range(3)]
        while not all(future.done() for future in made):
            if expected.exists():
                assert edges_of(expected) == edges
    assert {future.result() for future in made} == {expected}
    assert there_too_early == [False, False, False]
    assert files_in(cache) == {expected}


def test_processes_that_make_the_same_network_get_one_complete_file(cache: Path) -> None:
    code = (
        "import sys, numpy as np\n"
        "from unjam.scenarios import Ring\n"
        "from unjam.worlds.sumo.networks import network_file\n"
        "road = Ring(length=(260, 260)).draw(np.random.default_rng(0)).network\n"
        "print('ready', flush=True)\n"
        "sys.stdin.readline()\n"
        "print(network_file(road))\n"
    )
    processes = [
        subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    answers = {process.communicate(timeout=60)[0].strip() for process in processes}
    assert [process.returncode for process in processes] == [0, 0]
    assert answers == {str(network_file(road_of(260)))}
    assert files_in(cache) == {network_file(road_of(260))}
    assert len(edges_of(network_file(road_of(260)))) == 4


def test_a_road_that_cannot_be_made_leaves_nothing_behind(cache: Path) -> None:
    first, *others = road_of(230).edges
    road = replace(road_of(230), edges=(first._replace(from_node="node_9"), *others))
    for _ in range(2):
        with pytest.raises(EpisodeError, match="from-node 'node_9' is not known"):
            network_file(road)
    assert files_in(cache) == {cache / "networks"}


@pytest.mark.usefixtures("no_sumo")
def test_a_missing_netconvert_is_named_with_the_way_to_get_it(cache: Path) -> None:
    with pytest.raises(MissingPartError, match="netconvert is not installed; install it: pip install eclipse-sumo"):
        network_file(road_of(230))
    assert files_in(cache) <= {cache / "networks"}


@pytest.mark.usefixtures("no_sumo")
def test_a_netconvert_on_the_path_is_used_without_the_packages(tmp_path: Path) -> None:
    program = tmp_path / "netconvert"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    assert sumo_program("netconvert") == str(program)


@pytest.mark.parametrize("folder", ["file/cache", "/proc/cache"])
def test_a_cache_that_cannot_be_a_folder_is_a_disk_error(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("UNJAM_CACHE", str(tmp_path / folder))
    with pytest.raises(DiskError, match=rf"cannot write .*{folder}/networks: .*UNJAM_CACHE can name another"):
        network_file(road_of(230))


@pytest.mark.parametrize("problem", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EPERM])
def test_a_full_disk_is_a_disk_error_and_leaves_nothing_behind(
    problem: int, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any, **options: Any) -> NoReturn:
        raise OSError(problem, os.strerror(problem))

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(DiskError, match=f"cannot write .*networks.*: {os.strerror(problem)}"):
        network_file(road_of(230))
    assert files_in(cache) == {cache / "networks"}


@pytest.mark.parametrize("size", [0, 500, 4096])
@pytest.mark.parametrize("write", [lambda place: network_file(road_of(230)), partial(write_example_road, "on-ramp")])
def test_a_network_above_the_limit_of_file_sizes_is_a_full_disk(
    write: Callable[[Path], object], size: int, cache: Path, tmp_path: Path
) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        with pytest.raises((DiskError, OSError)) as caught:
            write(tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert isinstance(as_unjam_error(caught.value), DiskError)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:700])


def edit(path: Path) -> None:
    path.write_text(path.read_text().replace('speed="30.00"', 'speed="3.00"').replace("57.5", "58.5"))


def empty(path: Path) -> None:
    path.write_bytes(b"")


def unsealed(path: Path) -> None:
    path.write_text(path.read_text().rpartition("<!--")[0])


@pytest.mark.parametrize("damage", [cut, edit, empty, unsealed])
def test_a_changed_network_is_made_again(damage: Callable[[Path], None], cache: Path) -> None:
    made = network_file(road_of(230))
    whole = edges_of(made)
    damage(made)
    assert network_file(road_of(230)) == made
    assert edges_of(made) == whole
    assert files_in(cache) == {made}


def test_another_process_detects_a_changed_network(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = network_file(road_of(230))
    whole, stamp = made.read_bytes(), made.stat()
    made.write_bytes(whole.replace(b"57.5", b"58.5"))
    os.utime(made, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    monkeypatch.setattr(networks, "_intact_networks", {})
    assert edges_of(network_file(road_of(230))) == {f"edge_{index}": 57.5 for index in range(4)}


def test_a_network_that_a_full_disk_cut_short_is_not_kept(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = subprocess.run

    def run_on_full_disk(command: list[str], **options: Any) -> Any:
        done = run(command, **options)
        (written,) = [word for word in command if word.startswith("--output-file=")]
        cut(Path(written.partition("=")[2]))
        return done

    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "run", run_on_full_disk)
        with pytest.raises(DiskError, match="cannot write a temporary file: No space left on device"):
            network_file(road_of(230))
    assert files_in(cache) == {cache / "networks"}
    assert len(edges_of(network_file(road_of(230)))) == 4


def test_leftovers_are_removed_when_they_are_old_also_by_several_at_once(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, new, gone = (cache / "networks" / f".{name}.part" for name in ("old", "new", "gone"))
    old.parent.mkdir(parents=True)
    for path in (old, new, gone):
        path.touch()
    os.utime(old, (1, 1))

    def listed(path: Path) -> bool:
        gone.unlink(missing_ok=True)
        return is_leftover(path)

    monkeypatch.setattr(files, "is_leftover", listed)
    made = network_file(road_of(230))
    assert files_in(cache) == {made, new}
