"""What may import what: the order of the layers, and which packages stay out of which of them."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import unjam

SOURCE = Path(unjam.__file__).parents[1]
TEXTS = {
    path.relative_to(SOURCE).as_posix().removeprefix("unjam/"): path.read_text()
    for package in ("unjam", "unjam_paper")
    for path in (SOURCE / package).rglob("*.py")
}
"""sources of both packages, by path: `drivers/driver.py`, `unjam_paper/study.py`"""
MODULES = {module: ast.parse(text) for module, text in TEXTS.items()}

ORDER = (
    *("sumo_files", "physics", "drivers", "recordings", "scenarios", "worlds", "measures", "models", "learners"),
    *("training", "benchmarks", "cli", "unjam_paper"),
)
"""each may import those before it, and none after it"""
EVERYWHERE = {
    *("", "adam", "child_processes", "errors", "file_names", "files", "folders", "interruptions", "kernels"),
    *(
        "manifest",
        "onnx_models",
        "parameters",
        "plugins",
        "processes",
        "road_family",
        "sandbox",
        "seeds",
        "text",
        "tree",
        "trust",
        "user_code",
    ),
}
"""modules that every part may import: they import none of the layers"""
ALLOWED = {
    "adapters": {"physics", "drivers"},
    "controller": {"adapters", "physics", "drivers", "worlds"},
    "following": {"sumo_files", "physics", "drivers", "recordings", "scenarios"},
    "reports": {"physics", "drivers", "recordings", "scenarios", "worlds", "measures"},
    "models": {"following"},
    "training": {"adapters", "controller", "environments", "reports"},
    "benchmarks": {"controller", "reports"},
    "cli": {"controller", "following", "reports"},
    "unjam_paper": {"controller", "following", "reports"},
    "environments": {"controller", "physics", "drivers", "recordings", "scenarios", "worlds", "measures", "reports"},
}
"""what else a part may import"""
LAZY = {
    "__init__": {
        *("controller", "drivers", "environments", "errors", "interruptions", "kernels", "resource_limits"),
        *("benchmarks", "measures", "models", "scenarios", "seeds", "training", "trust", "worlds"),
    },
    "__main__": {"cli"},
    "resource_limits": {"child_processes", "controller", "errors", "trust"},
}
"""modules that import other parts when they are used"""
TORCH = {"torch", "stable_baselines3", "sb3_contrib"}
MAX_MODULE_LINES = 450
EXECUTABLE = ("sys.executable", "sys._base_executable", "executable", "_base_executable")


def imported_modules(tree: ast.AST) -> Iterator[str]:
    """Every module that is imported, wherever in the file, in whatever way."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name the whole module"
            assert node.module is not None
            yield node.module
            if node.module == "unjam":
                yield from (f"unjam.{alias.name}" for alias in node.names if not alias.name.startswith("__"))
        elif isinstance(node, ast.Call) and name_of(node.func) in ("import_module", "import_optional", "__import__"):
            yield from texts_of(node.args[0], tree)


def texts_of(argument: ast.expr, tree: ast.AST) -> list[str]:
    """The module names that the argument of an import at run time can be."""
    if isinstance(argument, ast.Constant):
        return [str(argument.value)]
    if isinstance(argument, ast.Subscript) and isinstance(argument.value, ast.Name):
        named = argument.value.id
    elif isinstance(argument, ast.Name):
        named = argument.id
    else:
        raise AssertionError(f"cannot tell what is imported by {ast.unparse(argument)}")
    return [
        constant.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and any(name_of(target) == named for target in node.targets)
        for constant in ast.walk(node.value)
        if isinstance(constant, ast.Constant) and isinstance(constant.value, str)
    ]


def name_of(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def part_of(module: str) -> str:
    """The part of the package that a file or a dotted name of it belongs to."""
    return module.removesuffix(".py").split("/")[0]


def importers(packages: set[str]) -> set[str]:
    """The files that import one of `packages` from outside."""
    return {
        module
        for module, tree in MODULES.items()
        if packages & {name.partition(".")[0] for name in imported_modules(tree)}
    }


def own_imports(tree: ast.AST) -> set[str]:
    """The parts of both packages that a file imports."""
    names = [name.split(".") for name in imported_modules(tree)]
    return {(*parts, "")[parts[0] == "unjam"] for parts in names if parts[0] in ("unjam", "unjam_paper")}


def allowed_parts(part: str) -> set[str]:
    if part in LAZY:
        return LAZY[part]
    before = set(ORDER[: ORDER.index(part) + 1]) if part in ORDER else {part}
    return EVERYWHERE | before | ALLOWED.get(part, set())


def test_a_module_imports_only_what_lies_below_it() -> None:
    for module, tree in MODULES.items():
        assert own_imports(tree) <= allowed_parts(part_of(module)), module


def test_common_modules_import_no_layer() -> None:
    for part in EVERYWHERE - {""}:
        assert own_imports(MODULES[f"{part}.py"]) <= EVERYWHERE


def test_every_part_has_its_place() -> None:
    known = {*ORDER, *ALLOWED, *EVERYWHERE, *LAZY}
    assert {part_of(module) for module in MODULES} <= known


def test_reports_read_folders_and_know_neither_learners_nor_trainings() -> None:
    for module, tree in MODULES.items():
        if part_of(module) == "reports":
            assert not own_imports(tree) & {"learners", "training", "controller", "cli"}, module


def test_measures_draw_nothing() -> None:
    drawing = {"matplotlib", "PIL"}
    for module in importers(drawing):
        assert part_of(module) != "measures", module
    for module, tree in MODULES.items():
        if part_of(module) == "measures":
            assert "reports" not in own_imports(tree), module
    assert not loaded_by("import unjam.measures.metrics, unjam.measures.statistics") & drawing


def test_sumo_is_imported_in_one_place() -> None:
    assert importers({"libsumo", "traci", "sumolib"}) == {"worlds/sumo/transports.py"}


def test_learning_libraries_are_imported_only_by_learning_parts() -> None:
    found = importers(TORCH)
    parts = {part_of(module) for module in found}
    learning = {"adam", "adapters", "controller", "following", "learners", "models", "training", "unjam_paper"}
    assert parts <= {*learning, "environments"}
    assert "learners/trpo_ppo.py" in found


def test_only_the_command_line_prints_with_its_libraries() -> None:
    found = importers({"typer", "rich", "click"})
    assert {part_of(module) for module in found - {"unjam_paper/cli.py"}} == {"cli"}


def test_dataclasses_are_checked_in_one_way_whose_errors_are_one_line() -> None:
    found = {module for module, tree in MODULES.items() if "pydantic.dataclasses" in imported_modules(tree)}
    assert found == {"parameters.py"}


def test_signatures_are_checked_in_one_place() -> None:
    assert importers({"cryptography"}) == {"controller/signature.py"}
    assert "cryptography" not in loaded_by("import unjam.controller.verify")


@pytest.mark.parametrize("package", ["pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "yaml"])
def test_nothing_reads_files_that_can_run_code(package: str) -> None:
    assert importers({package}) == set()


def calls(tree: ast.AST) -> Iterator[ast.Call]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.Call))


def test_nothing_is_evaluated_unpickled_or_given_to_a_shell() -> None:
    for module, call in [(module, call) for module, tree in MODULES.items() for call in calls(tree)]:
        where = f"{module}:{call.lineno}"
        if isinstance(call.func, ast.Name):
            assert call.func.id not in ("eval", "exec", "compile", "execfile"), where
        assert name_of(call.func) not in ("system", "popen"), where
        if ast.unparse(call.func).startswith("torch.load"):
            assert "weights_only=True" in map(ast.unparse, call.keywords), where
        for keyword in call.keywords:
            if keyword.arg in ("shell", "allow_pickle"):
                assert isinstance(keyword.value, ast.Constant), where
                assert keyword.value.value is False, where


WRITERS = {"files.py", "folders.py"}
"""what writes, renames and removes for all others, and follows no link that a stranger planted"""
CHANGES = {
    *("write_text", "write_bytes", "touch", "mkdir", "unlink", "rmdir", "symlink_to", "hardlink_to", "chmod"),
    *("lchmod", "extract", "extractall", "tofile", "savez", "savez_compressed", "save_file", "imsave"),
    *("FileHandler", "write_frames", "SummaryWriter", "JournalFileBackend", "memmap"),
}
"""calls that change files by their path, whatever they are called on"""
CHANGES_IF_GIVEN_A_PATH = {"save", "savefig", "to_csv", "to_parquet", "to_json", "to_pickle", "to_html"}
SYSTEM_CALLS = {
    *("open", "mkdir", "makedirs", "remove", "removedirs", "unlink", "rmdir", "rename", "renames", "replace"),
    *("link", "symlink", "truncate", "chmod", "chown", "mkfifo", "mknod"),
}
READS = {"shutil.which", "shutil.disk_usage", "shutil.get_terminal_size"}
PRIVATE = "in a private temporary folder, with a random name, that its user alone may enter"
BUFFER = "into memory, or to the standard output"
UNSAFE_BUT = {
    "worlds/sumo/simulation.py: self._traffic_file.write_text(inputs.traffic_xml, encoding='utf-8')": PRIVATE,
    "worlds/sumo/networks.py: (folder / name).write_text(content)": PRIVATE,
    "unjam_paper/open_test_roads.py: (folder / 'road.rou.xml').write_text(routes)": PRIVATE,
    "unjam_paper/open_test_roads.py: path.write_text(f'<configuration>{lines}</configuration>')": PRIVATE,
    "unjam_paper/assess_examples.py: road.mkdir()": PRIVATE,
    "unjam_paper/assess_examples.py: (folder / 'road.rou.xml').write_text('\\n'.join(lines))": PRIVATE,
    "unjam_paper/assess_examples.py: shutil.copy(network_file(road.network), folder / 'road.net.xml')": PRIVATE,
    "sumo_files/reader_program.py: open(copy, 'w', encoding='utf-8')": PRIVATE,
    "reports/video.py: imageio_ffmpeg.write_frames(str(video), (FRAME_SIZE, FRAME_SIZE), fps=rate, "
    "ffmpeg_log_level='error')": PRIVATE,
    "training/tensorboard.py: SummaryWriter(str(log_folder), filename_suffix=f'.{secrets.token_hex(8)}')": (
        "the name of its file cannot be guessed, and its folder was made without following links"
    ),
    "training/train.py: self._controllers.save(contents, is_scheduled)": "through `unjam.files`",
    "cli/__init__.py: os.open(os.devnull, os.O_WRONLY)": "no file",
    "cli/__init__.py: open(os.devnull, mode)": "no file",
    "sandbox.py: os.open(path, os.O_PATH | os.O_CLOEXEC)": "a handle, by which nothing can be written",
    "cli/catalog.py: draw_road(scene, max_speed, caption).save(content, 'PNG')": BUFFER,
    "adapters/stable_baselines3_export.py: model.save(content)": BUFFER,
    "reports/figures.py: figure.savefig(content, format='svg', dpi=DPI, metadata={'Date': None})": BUFFER,
    "reports/figures.py: figure.savefig(content, format='png', dpi=DPI)": BUFFER,
    "reports/figures.py: opaque.quantize(256, Image.Quantize.MAXCOVERAGE).save(content, 'PNG')": BUFFER,
    "reports/video.py: next(frames).save(content, kind, save_all=True, append_images=frames, "
    "duration=durations, loop=0)": BUFFER,
}
"""calls that change no file that a stranger's link could stand for, and why not"""


def changes_files(call: ast.Call) -> bool:
    """Whether a call may write, rename or remove a file by its path."""
    called, name = ast.unparse(call.func), name_of(call.func)
    if name == "open" and called != "os.open":
        if call.args and ast.unparse(call.args[0]).startswith("open_in_place("):
            return False  # it has a descriptor already
        modes = [*call.args[called == "open" : 2], *(word.value for word in call.keywords if word.arg == "mode")]
        known = [str(mode.value) for mode in modes if isinstance(mode, ast.Constant)]
        unknown = called == "open" and len(known) < len(modes)
        return unknown or any(set("wax+") & set(mode) and set(mode) <= set("rwaxbt+") for mode in known)
    if called.startswith(("os.", "shutil.")):
        return called not in READS and (called.startswith("shutil.") or name in SYSTEM_CALLS)
    if name in ("rename", "replace") and isinstance(call.func, ast.Attribute):
        return len(call.args) == 1 and not call.keywords  # those of texts and tables have more
    return name in CHANGES or (
        name in CHANGES_IF_GIVEN_A_PATH and isinstance(call.func, ast.Attribute) and bool(call.args)
    )


@pytest.mark.parametrize(
    "line",
    [
        *("open(path, 'w')", "open(path, mode='ab')", "open(path, 'r+b')", "open(path, how)"),
        *(
            "path.open('x')",
            "path.open(mode='w')",
            "gzip.open(path, 'wb')",
            "path.write_text('')",
            "path.write_bytes(b'')",
        ),
        *("shutil.rmtree(path)", "shutil.copyfile(a, b)", "os.replace(a, b)", "os.open(path, flags)"),
        *("path.rename(other)", "path.replace(other)", "path.unlink()", "path.parent.mkdir(parents=True)"),
        *("figure.savefig(path)", "frame.to_csv(path)", "np.savez(path, a)", "image.save(path)"),
    ],
)
def test_a_call_that_changes_files_is_recognized(line: str) -> None:
    assert changes_files(next(calls(ast.parse(line))))


def test_files_are_changed_in_one_place_which_follows_no_link() -> None:
    found = {
        f"{module}: {ast.unparse(call)}"
        for module, tree in MODULES.items()
        if module not in WRITERS
        for call in calls(tree)
        if changes_files(call)
    }
    assert found == set(UNSAFE_BUT)


def test_a_users_file_is_run_in_one_place() -> None:
    found = {module for module, tree in MODULES.items() for call in calls(tree) if name_of(call.func) == "exec_module"}
    assert found == {"user_code.py"}


@pytest.mark.long
def test_python_children_start_in_one_way() -> None:
    """Another way could leave out what keeps the working folder off their import path."""
    for module, tree in MODULES.items():
        for node in ast.walk(tree):
            named = isinstance(node, ast.Attribute) and ast.unparse(node) in EXECUTABLE
            assert not named or module == "child_processes.py", module
            assert not isinstance(node, ast.alias) or node.name not in EXECUTABLE, module
        called = {name_of(call.func) for call in calls(tree)}
        assert "python_command" not in called or "child_environment" in called, module
    started_by_a_library = importers({"multiprocessing", "ray"})
    assert started_by_a_library == {"unjam_paper/results_file.py", "training/executors.py"}
    for module in started_by_a_library:
        assert "isolated_start" in {name_of(call.func) for call in calls(MODULES[module])}


PROCESS_WIDE = {
    *("redirect_stdout", "redirect_stderr", "os.dup2", "chdir", "os.chdir", "os.umask", "gc.freeze", "gc.disable"),
    *("warnings.catch_warnings", "warnings.simplefilter", "warnings.filterwarnings", "logging.basicConfig"),
    *("signal.signal", "signal.alarm", "torch.set_num_threads", "torch.manual_seed", "np.random.seed"),
    *("os.environ.update", "os.environ.pop", "os.environ.setdefault", "sys.path.insert", "sys.path.append"),
}
"""calls that change what other threads of the process, and the user's code in it, see"""
CHANGES_THE_PROCESS = {
    "processes": "functions for processes of unjam",
    "sandbox": "functions for processes of unjam",
    "interruptions": "in the command line",
    "kernels": "when unjam is imported",
    "trust": "for the length of a block that the user writes, under a lock",
    "child_processes": "in the command line, and while Ray or multiprocessing starts processes",
    "training/random_state": "for the length of a training, under a lock, and restored",
    "learners/algorithm": "within training/train",
    "training/model_facts": "within training/train, or in the command line",
    "training/speed": "in the command line",
    "following/networks": "in the command line",
    "unjam_paper/theory": "in the command line",
    "onnx_models": "while a network is written, and restored",
    "worlds/worker": "in a worker",
    "worlds/episode": "for the length of an episode, under a lock, and restored",
    "worlds/messages": "in a worker, or in a process that runs SUMO",
    "cli/__init__": "in the command line",
    "cli/controllers": "in the command line",
}
"""modules that make such calls, and when"""


def test_process_wide_settings_are_changed_only_in_the_listed_modules() -> None:
    found = {
        module.removesuffix(".py")
        for module, tree in MODULES.items()
        for call in calls(tree)
        if ast.unparse(call.func) in PROCESS_WIDE
    }
    assert found == set(CHANGES_THE_PROCESS)


def test_modules_are_short() -> None:
    lengths = {module: len(text.splitlines()) for module, text in TEXTS.items()}
    assert not {module: lines for module, lines in lengths.items() if lines > MAX_MODULE_LINES}


def loaded_by(program: str) -> set[str]:
    """The packages that are loaded after `program`, in a process of its own."""
    lines = [program, "import sys", "print('loaded:', *sys.modules)"]
    ran = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, timeout=120, check=True
    )
    return set(ran.stdout.rpartition("loaded:")[2].split())


HELP = """
from unjam.cli import app
for words in ("--help", "--version", "train --help", "drive --help", "fit-drivers --help"):
    try:
        app(words.split(), standalone_mode=True)
    except SystemExit as end:
        assert not end.code, words
"""


def test_help_loads_nothing_that_takes_time() -> None:
    found = loaded_by(HELP)
    assert "typer" in found
    assert not found & (TORCH | {"libsumo", "traci", "matplotlib", "pandas", "scipy", "cryptography"})


def test_modules_without_learning_load_no_learning_library() -> None:
    of_training = [f"unjam.training.{name}" for name in ("evaluate", "run_folder", "config")]
    modules = ["unjam.worlds.worker", "unjam.controller", *of_training]
    found = loaded_by(f"import {', '.join(modules)}")
    assert found >= set(modules)
    assert not found & TORCH


def test_a_worker_loads_neither_tables_nor_pictures() -> None:
    assert not loaded_by("import unjam.worlds.worker") & {"pandas", "matplotlib"}
