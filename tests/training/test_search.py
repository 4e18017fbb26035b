"""Searches on a ring so small that a training takes a second."""

import json
import math
import time
from pathlib import Path
from typing import Any

import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from tests.training.test_run import small_config
from unjam.errors import InputError, UnjamError
from unjam.files import to_json
from unjam.training.config import load_config
from unjam.training.executors import CommandLine, LocalExecutor
from unjam.training.run_folder import save_checkpoint
from unjam.training.search import (
    SearchTrial,
    _propose_trials,
    _restore_study,
    check_search_space,
    describe_trial,
    search,
    trial_config,
    validation_gain,
)
from unjam.training.search_space import parse_search_space
from unjam.training.trial_log import REQUEST_FILE, TRIALS_FILE, TrialLog

BASE = small_config(evaluation__validation_interval=1)
SPACE = parse_search_space(["trpo.target_kl=0.001..0.1:log", "trpo.critic_batch_size=8,16", "trpo.critic_epochs=1..9"])


def test_search_space_is_parsed() -> None:
    assert parse_search_space(["trpo.gamma=0.9..0.99", "a=1..8", "b=1e-3..1:log", "expert=pi,bcm", "c=true,1,2.5"]) == {
        "trpo.gamma": FloatDistribution(0.9, 0.99),
        "a": IntDistribution(1, 8),
        "b": FloatDistribution(0.001, 1.0, log=True),
        "expert": CategoricalDistribution(("pi", "bcm")),
        "c": CategoricalDistribution((True, 1, 2.5)),
    }
    assert parse_search_space(["a=1..8.0"]) == {"a": FloatDistribution(1.0, 8.0)}


@pytest.mark.parametrize(
    "text", ["a", "=1..2", "a=", "a=2..1", "a=1..1", "a=0..1:log", "a=x..y", "a=1..2..3", "a=0..inf", "a=true..2"]
)
def test_invalid_range_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"^vary: .* is not allowed; allowed: [^\n]*$"):
        parse_search_space([text])


def test_empty_search_space_is_refused() -> None:
    with pytest.raises(InputError, match="at least one key is needed"):
        parse_search_space([])


@pytest.mark.parametrize(
    ("changes", "text", "words"),
    [
        ({}, "trpo.nothing=1..2", "trpo.nothing: unknown name"),
        ({}, "trpo.gamma=0.9..1.5", "trpo.gamma: 1.5 is not allowed"),
        ({}, "expert=pi,nonesuch", "nonesuch"),
        ({"evaluation__validation_interval": 0}, "trpo.gamma=0.9..0.99", "compared by validations"),
    ],
)
def test_impossible_search_is_refused(changes: dict[str, Any], text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        check_search_space(
            small_config(**{"evaluation__validation_interval": 1, **changes}), parse_search_space([text])
        )


def test_trial_differs_from_the_base_only_in_its_values() -> None:
    changed = trial_config(BASE, {"trpo.gamma": 0.5, "scenario_options.vehicles": 7})
    assert (changed.trpo.gamma, changed.make_scenario().possible_cav_ids()) == (0.5, ("cav_0",))
    assert trial_config(changed, {"trpo.gamma": BASE.trpo.gamma, "scenario_options.vehicles": 8}) == BASE
    preset, agent = load_config(preset="rings"), {"agent": "my.py:A"}
    assert trial_config(preset, agent) == load_config(preset="rings", changes=agent)


def test_validation_gain_is_the_best_validation_minus_the_expert(tmp_path: Path) -> None:
    rows = [(None, 10.0), (12.0, 10.0), (17.0, 10.0), (11.0, 10.0)]
    lines = [
        to_json({"iteration": number, "return_validation": found, "return_expert": expert})
        for number, (found, expert) in enumerate(rows, 1)
    ]
    (tmp_path / "progress.jsonl").write_text("\n".join(lines))
    assert validation_gain(tmp_path) == 7.0
    (tmp_path / "progress.jsonl").write_text(lines[0])
    assert validation_gain(tmp_path) is None


@pytest.mark.parametrize(
    ("gain", "last", "words"),
    [
        (7.0, 1.0, "trial 3: validation gain over expert +7.0, last checkpoint +1.0: agent=ppo"),
        (
            -2.0,
            -3.0,
            "trial 3: validation gain over expert -2.0, last checkpoint -3.0 (the controller is the untrained "
            "network): agent=ppo",
        ),
        (None, None, "trial 3: failed: agent=ppo"),
    ],
)
def test_trial_text_has_the_gain_of_the_last_checkpoint(gain: float | None, last: float | None, words: str) -> None:
    assert describe_trial(SearchTrial(3, {"agent": "ppo"}, Path("trials/3"), gain, last)) == words


EXPERT_RETURNS = {"constant": 100.0}
"""experts that earn something, in trainings that stand for real ones"""


class Trainings:
    """Stands for trainings: each is worth what its target_kl says, and can be made to fail or to stop."""

    def __init__(self) -> None:
        self.done: list[Path] = []
        self.stop_at: int | None = None
        self.failing_code = 0
        self.seconds = 0.0

    def __call__(self, command: CommandLine) -> int:
        if len(self.done) == self.stop_at:
            raise KeyboardInterrupt
        time.sleep(self.seconds)
        if self.failing_code:
            return self.failing_code
        config = load_config(Path(command.argv()[6]))
        folder = Path(command.arguments[-1])
        folder.mkdir(parents=True, exist_ok=True)
        worth = -abs(math.log10(config.trpo.target_kl) + 2)
        expert = EXPERT_RETURNS.get(config.expert, 0.0)
        row = {"iteration": 1, "return_validation": expert + worth, "return_expert": expert}
        (folder / "progress.jsonl").write_text(to_json(row))
        self.done.append(folder)
        return 0


@pytest.fixture
def trainings(monkeypatch: pytest.MonkeyPatch) -> Trainings:
    made = Trainings()
    monkeypatch.setattr(LocalExecutor, "run", lambda self, command: made(command))
    return made


def test_best_trial_comes_first_and_is_written(tmp_path: Path, trainings: Trainings) -> None:
    found = search(BASE, SPACE, 25, tmp_path / "search", 2)
    gains = [trial.gain for trial in found]
    assert len(found) == len(trainings.done) == 25
    assert gains == sorted(gains, key=lambda gain: gain or 0.0, reverse=True)
    # Found, not stumbled upon: the last trials are nearer to the best value than the first.
    ordered = sorted(found, key=lambda trial: trial.number)
    early, late = (sum(trial.gain or 0.0 for trial in part) for part in (ordered[:10], ordered[-10:]))
    assert late > early
    best = load_config(tmp_path / "search" / "best.toml")
    assert best == trial_config(BASE, found[0].values)
    assert abs(math.log10(best.trpo.target_kl) + 2) < 0.2
    written = json.loads((tmp_path / "search" / "search.json").read_text())
    assert [row["gain"] for row in written["trials"]] == pytest.approx(gains)
    assert all(row["last_gain"] <= row["gain"] for row in written["trials"])
    assert written["manifest"]["packages"]["torch"]


def test_values_are_within_their_ranges(tmp_path: Path, trainings: Trainings) -> None:
    for trial in search(BASE, SPACE, 12, tmp_path, 3):
        assert 0.001 <= trial.values["trpo.target_kl"] <= 0.1
        assert trial.values["trpo.critic_batch_size"] in (8, 16)
        assert isinstance(trial.values["trpo.critic_epochs"], int)
        assert 1 <= trial.values["trpo.critic_epochs"] <= 9


def test_a_search_shows_how_far_trainings_are(
    tmp_path: Path, trainings: Trainings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("unjam.training.search.MESSAGE_INTERVAL", 0.01)
    trainings.seconds, messages = 0.2, list[str]()
    search(BASE, SPACE, 2, tmp_path, 2, on_message=messages.append)
    assert f"steps of {BASE.steps:,}: trial 0 0, trial 1 0" in messages
    assert sum(message.startswith("2 of 2: trial ") for message in messages) == 1


def test_search_ends_if_a_file_changes_while_it_runs(
    tmp_path: Path, trainings: Trainings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("unjam.trust.is_all_code_trusted", lambda: True)
    file = tmp_path / "mine.py"
    file.write_text("def calm(outcome): return 0.0\n")
    base, messages = trial_config(BASE, {"reward": f"{file}:calm"}), list[str]()

    def change(message: str) -> None:
        messages.append(message)
        file.write_text("def calm(outcome): return 1.0\n")

    with pytest.raises(InputError, match=r"mine\.py: has changed since the start; allowed"):
        search(base, SPACE, 3, tmp_path / "out", 1, on_message=change)
    assert len(messages) == 1
    assert (tmp_path / "out" / TRIALS_FILE).read_text().count('"objective"') == 1


@pytest.mark.parametrize(("code", "exit_code"), [(74, 74), (3, 1), (143, 1), (-9, 1)])
def test_trials_that_were_stopped_resume(code: int, exit_code: int, tmp_path: Path, trainings: Trainings) -> None:
    trainings.failing_code = code
    with pytest.raises(UnjamError, match=rf"trial 0 was stopped with exit code {code}; its log: .*0000\.log") as caught:
        search(BASE, SPACE, 3, tmp_path, 1)
    assert caught.value.exit_code == exit_code
    trainings.failing_code = 0
    assert [trial.gain for trial in search(BASE, SPACE, 3, tmp_path, 1)].count(None) == 0
    assert len(trainings.done) == 3


@pytest.mark.parametrize("varied", ["trpo.gamma=0.9..0.99", "expert=pi,{file}:calm"])
def test_search_does_not_resume_after_a_file_has_changed(
    varied: str, tmp_path: Path, trainings: Trainings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("unjam.trust.is_all_code_trusted", lambda: True)
    file, space = tmp_path / "mine.py", parse_search_space([varied.format(file=tmp_path / "mine.py")])
    file.write_text("def calm(state): return 0.0 * state.speed\n")
    base = trial_config(BASE, {} if "mine" in repr(space) else {"reward": f"{file}:calm"})
    search(base, space, 1, tmp_path / "out", 1)
    file.write_text("def calm(state): return 1.0 * state.speed\n")
    with pytest.raises(InputError, match=r"other settings \(.*mine\.py.* has changed\)"):
        search(base, space, 2, tmp_path / "out", 1)
    assert len(trainings.done) == 1


@pytest.mark.parametrize("workers", [1, 2])
def test_interrupted_search_resumes(tmp_path: Path, trainings: Trainings, workers: int) -> None:
    trainings.stop_at = 4
    with pytest.raises(KeyboardInterrupt):
        search(BASE, SPACE, 8, tmp_path, workers)
    assert not (tmp_path / "best.toml").exists()
    trainings.stop_at = None
    found = search(BASE, SPACE, 8, tmp_path, workers)
    assert sorted(trial.number for trial in found) == list(range(8))
    assert None not in [trial.gain for trial in found]
    assert len(set(trainings.done)) == len(trainings.done) == 8
    assert len({trial.values["trpo.target_kl"] for trial in found}) == 8


def test_search_resumes_only_with_the_same_settings(tmp_path: Path, trainings: Trainings) -> None:
    search(BASE, SPACE, 2, tmp_path, 1)
    assert len(search(BASE, SPACE, 5, tmp_path, 1)) == 5
    assert len(trainings.done) == 5
    with pytest.raises(InputError, match=r"was made with other settings \(space: .* there, .* now\); allowed"):
        search(BASE, parse_search_space(["trpo.target_kl=0.001..0.2"]), 6, tmp_path, 1)
    with pytest.raises(InputError, match="was made with other settings"):
        search(small_config(seed=1), SPACE, 6, tmp_path, 1)


@pytest.mark.parametrize(
    "row",
    [
        {"proposal": 1, "values": {"expert": "code.py:of_others"}},
        {"proposal": 1, "values": {}},
        {"proposal": 1, "values": {"expert": "pi", "reward": "code.py:of_others"}},
        {"proposal": 1, "values": ["expert"]},
        {"trial": []},
    ],
)
def test_stored_trials_outside_the_space_are_refused(row: dict[str, Any], tmp_path: Path, trainings: Trainings) -> None:
    space = parse_search_space(["expert=pi,bcm"])
    search(BASE, space, 1, tmp_path, 1)
    with (tmp_path / TRIALS_FILE).open("a") as file:
        file.write(f"{to_json(row)}\n")
    with pytest.raises(InputError, match=r"^out: trials\.jsonl has a trial outside the search space"):
        search(BASE, space, 3, tmp_path, 1)
    assert len(trainings.done) == 1


def test_a_log_without_one_of_its_trials_is_refused(tmp_path: Path, trainings: Trainings) -> None:
    search(BASE, SPACE, 2, tmp_path, 1)
    rows = (tmp_path / TRIALS_FILE).read_text().splitlines(keepends=True)
    (tmp_path / TRIALS_FILE).write_text("".join(row for row in rows if '"proposal": 0' not in row))
    with pytest.raises(InputError, match=r"^out: trials\.jsonl does not have all trials"):
        search(BASE, SPACE, 3, tmp_path, 1)


@pytest.mark.parametrize("starts", [None, 5, "abc", [1]])
def test_a_damaged_request_is_refused(starts: Any, tmp_path: Path) -> None:
    TrialLog(tmp_path, {"seed": 1})
    stored = json.loads((tmp_path / REQUEST_FILE).read_text())
    (tmp_path / REQUEST_FILE).write_text(to_json({**stored, "starts": starts}))
    with pytest.raises(InputError, match=r"^out: request\.json in .* is damaged; allowed: a new folder"):
        TrialLog(tmp_path, {"seed": 1})


@pytest.mark.parametrize(("score", "verdict"), [("abc", ""), ([1], ""), (1e999, ""), (True, ""), (1.0, 5)])
def test_damaged_verdicts_are_measured_again(score: Any, verdict: Any, tmp_path: Path) -> None:
    TrialLog(tmp_path, {}).add(0, "pi", (2.0, "feasible"))
    row = {"first_seed": 0, "driver": "acc", "score": score, "verdict": verdict}
    with (tmp_path / TRIALS_FILE).open("a") as file:
        file.write(f"{json.dumps(row)}\n")
    assert TrialLog(tmp_path, {}).verdicts == {(0, "pi"): (2.0, "feasible")}


def test_folder_with_other_files_is_not_changed(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").touch()
    with pytest.raises(InputError, match="is not empty; allowed: a new folder, or that of the same request"):
        search(BASE, SPACE, 2, tmp_path, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_failure_of_all_trials_is_reported(tmp_path: Path, trainings: Trainings) -> None:
    trainings.failing_code = 2
    messages: list[str] = []
    with pytest.raises(UnjamError, match="no training of 3 trials ended; their logs are in"):
        search(BASE, SPACE, 3, tmp_path, 2, on_message=messages.append)
    assert all(line.endswith("failed") for line in messages)


@pytest.mark.parametrize("kept", [[], [1], [1, 3], [2, 3]])
def test_a_repeated_search_refuses_the_cut_progress_of_a_finished_trial(
    kept: list[int], tmp_path: Path, trainings: Trainings
) -> None:
    search(BASE, SPACE, 2, tmp_path, 1)
    file = tmp_path / "trials" / "0001" / "progress.jsonl"
    row = json.loads(file.read_text())
    save_checkpoint(file.parent / "checkpoint", {"iteration": 3}, {})
    file.write_text("".join(f"{to_json(row | {'iteration': each})}\n" for each in (1, 2, 3)))
    assert len(search(BASE, SPACE, 2, tmp_path, 1)) == 2
    before = (tmp_path / "search.json").read_bytes()
    file.write_text("".join(f"{to_json(row | {'iteration': each})}\n" for each in kept))
    with pytest.raises(InputError, match=rf"^{file}: rows? .* missing; allowed: all rows up to 3"):
        search(BASE, SPACE, 2, tmp_path, 1)
    assert (tmp_path / "search.json").read_bytes() == before


@pytest.mark.slow
def test_search_runs_real_trainings(tmp_path: Path) -> None:
    found = search(BASE, SPACE, 2, tmp_path, 2)
    for trial in found:
        assert trial.gain == validation_gain(trial.folder)
        assert (trial.folder / "report.html").is_file()


def test_search_over_experts_maximizes_the_return(tmp_path: Path, trainings: Trainings) -> None:
    space = parse_search_space(["expert=constant,pi", "trpo.target_kl=0.001..0.1:log"])
    best, *_ = search(BASE, space, 12, tmp_path / "search", 1)
    assert best.values["expert"] == "constant"
    worth = -abs(math.log10(best.values["trpo.target_kl"]) + 2)
    assert best.gain == pytest.approx(worth), "relative to its expert, whatever the return of the expert is"


def test_an_interrupted_search_proposes_the_same_trials(tmp_path: Path) -> None:
    space = parse_search_space(["trpo.target_kl=0.001..0.1:log", "trpo.critic_epochs=1,2,3"])

    def propose(folder: Path, trials: int) -> list[dict[str, Any]]:
        log = TrialLog(folder, {})
        study = _restore_study(log, space)
        proposed = list[dict[str, Any]]()
        for number, values in _propose_trials(study, log, space, trials, 3):
            proposed.append(values)
            log.append({"trial": number, "objective": values["trpo.target_kl"]})
            study.tell(number, values["trpo.target_kl"])
        return proposed

    whole = propose(tmp_path / "whole", 16)
    parts = [values for trials in (3, 12, 16) for values in propose(tmp_path / "parts", trials)]
    assert parts == whole
    assert len({values["trpo.target_kl"] for values in whole}) == 16
