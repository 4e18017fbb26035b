"""The report: one HTML page with everything in it, no network needed."""

import json
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from unjam import __version__
from unjam.files import check_folder, write_whole
from unjam.measures.statistics import estimate
from unjam.reports.figures import (
    data_uri,
    learning_curve,
    over_time,
    space_time,
    time_split,
)
from unjam.reports.model_figures import errors, examples, trust
from unjam.reports.model_story import model_section
from unjam.reports.replay import replay_data
from unjam.reports.results import Results, Shown, command_to_repeat, read_results
from unjam.reports.story import Column, cards_of, columns_of, lead_of, names_of, notes_of, table_of, title_of

MOST_PANELS = 6


def write_report(folders: Sequence[Path], target: Path) -> Path:
    """Write the report of one folder of results, or a comparison of several; return its path.

    Raises:
        InputError: a folder holds no results.
        DiskError: the page cannot be written, or there is no folder for it.
    """
    check_folder(target)
    results = [read_results(folder) for folder in folders]
    write_whole(target, render(results))
    return target


def render(results: Sequence[Results]) -> str:
    """Return the page as text."""
    page = files("unjam.reports") / "page"
    columns = columns_of(results)
    panels = [_renamed(column) for column in columns if column.shown is not None][:MOST_PANELS]
    pictures = _pictures(results, panels)
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string((page / "report.html").read_text(encoding="utf-8"))
    single = results[0] if len(results) == 1 else None
    names = names_of(results)
    return template.render(
        version=__version__,
        title=title_of(results),
        lead=lead_of(single)
        if single
        else " ".join(f"{name}: {lead_of(result)}" for name, result in zip(names, results, strict=True)),
        notes=[
            note if single else f"{name}: {note}"
            for name, result in zip(names, results, strict=True)
            for note in notes_of(result)
        ],
        cards=cards_of(single) if single else [],
        pictures=pictures,
        picture=lambda name, text: _picture(pictures[name], text),
        panels_note=_panels_note(panels, len(columns)),
        over_time_title="Speed, gap and waves over time"
        if all(episode.closed for episode in panels)
        else "Speed, waves and queues over time",
        learning_note="Validation uses fixed seeds and chooses the controller; the table uses other seeds.",
        model=model_section(single) if single else None,
        columns=[column.name for column in columns],
        table=table_of(columns),
        table_note=_table_note(columns),
        failures="; ".join(
            f"{column.name} seed {row['seed']}: {row['reason']}"
            for column in columns
            for row in column.rows
            if row["status"] == "failed"
        ),
        sources=[_source(result, name) for result, name in zip(results, names, strict=True)],
        style=Markup((page / "report.css").read_text(encoding="utf-8")),
        script=Markup((page / "replay.js").read_text(encoding="utf-8")),
        replay_data=Markup(json.dumps(replay_data(panels)).replace("<", "\\u003c")),
    )


def _renamed(column: Column) -> Shown:
    assert column.shown is not None
    return Shown(**{**vars(column.shown), "driver": column.name})


def _panels_note(panels: Sequence[Shown], drivers: int) -> str:
    """Return what the panels have in common, and whether all drivers are among them."""
    drawn = [", ".join(f"{key} {value:g} m" for key, value in episode.drawn.items()) for episode in panels]
    if len(set(drawn)) == 1:
        note = "the same traffic and seed in each panel" + (f" ({drawn[0]})" if drawn[0] else "")
    else:
        note = "different roads or traffic in the panels"
    return note + (f"; the first {len(panels)} of {drivers} drivers" if len(panels) < drivers else "")


def _table_note(columns: Sequence[Column]) -> str:
    counts = sorted({len(column.rows) for column in columns})
    episodes = " to ".join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))
    return (
        f"Mean over {episodes} episodes, deterministic drivers, fixed seeds; in brackets the 95 % bootstrap "
        "interval."
    )


def _pictures(results: Sequence[Results], panels: Sequence[Shown]) -> dict[str, tuple[str, str]]:
    """Return each picture as two `data:` addresses: for a screen, and for a phone."""
    pictures: dict[str, tuple[str, str]] = {}

    def add(name: str, kind: Literal["png", "svg"], draw: Callable[[bool], Figure]) -> None:
        pictures[name] = (data_uri(draw(True), kind), data_uri(draw(False), kind))

    if panels:
        add("space_time", "png", lambda wide: space_time(panels, wide))
        add("over_time", "svg", lambda wide: over_time(panels, wide))
    named = zip(names_of(results), results, strict=True)
    runs = {name: result.progress for name, result in named if result.progress}
    if runs:
        references = _references(results)
        add("learning_curve", "svg", lambda wide: learning_curve(runs, references, wide))
    if len(results) == 1 and results[0].progress:
        progress, model = results[0].progress, results[0].model
        add("time_split", "svg", lambda wide: time_split(progress, wide))
        if model is not None:
            add("model_examples", "svg", lambda wide: examples(model, wide))
            add("model_errors", "svg", lambda wide: errors(model, wide))
            add("model_trust", "svg", lambda wide: trust(progress, model, wide))
    return pictures


def _references(results: Sequence[Results]) -> dict[str, float]:
    """Return the returns of drivers that do not learn.

    The expert's is that on the validation seeds, from which the curve starts; the others were never driven
    there, and have those of the held-out seeds.
    """
    found: dict[str, float] = {}
    for result in results:
        expert = result.about.get("expert", "none")
        if result.progress and expert != "none":
            found.setdefault(f"{expert}, validation", result.progress[0]["return_expert"])
        for label, rows in result.rows.items():
            if label not in (result.trained, expert):
                found.setdefault(f"{label}, held-out", estimate([row["return"] for row in rows]).mean)
    return found


def _picture(both: tuple[str, str], text: str) -> Markup:
    wide, narrow = both
    small = f'<source media="(max-width: 640px)" srcset="{narrow}">'
    return Markup(f'<picture>{small}<img src="{wide}" alt="{escape(text)}"></picture>')


def _source(result: Results, name: str) -> dict[str, Any]:
    about = result.about.get("manifest", {})
    packages = ", ".join(
        f"{name} {version}" for name, version in about.get("packages", {}).items() if version
    )
    commit = f", commit {about['commit']}" if about.get("commit") else ""
    made_with = f"unjam {about.get('unjam')}{commit}, Python {about.get('python')}, {packages}"
    facts = f"{made_with}; {about.get('started', '')}."
    return {
        "name": name,
        "command": command_to_repeat(result),
        "facts": facts,
        "config": result.config,
    }
