"""List what three searches tried on the jammed ring, from their journals: settings.py > settings.json."""

import json
from pathlib import Path

from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.study import load_study
from optuna.trial import TrialState

HERE = Path(__file__).parent
TUNED = "unjam:ring-jammed-tuned"
EXPERTS = {(TUNED, 1500): 739.0, ("unjam:ring-gap-tuned", 1500): 591.3, (TUNED, 3000): 1966.8}
"""mean returns of experts on the 32 validation seeds, by horizon, of the progress of trials"""


def trials(journal: str, expert: str = "", horizon: int = 1500) -> list[dict[str, object]]:
    """Return the settings of all trials that ended, with what they had beyond their expert in validation.

    `expert` is that of all trials of a journal in which it was not varied.
    """
    study = load_study(study_name="search", storage=JournalStorage(JournalFileBackend(str(HERE / journal))))
    ended = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    return [
        {
            "search": journal,
            "trial": trial.number,
            "horizon": horizon,
            "expert": expert or trial.params["expert"],
            **{key: value for key, value in trial.params.items() if key != "expert"},
            "beyond its expert": trial.value,
            "return": EXPERTS[expert or trial.params["expert"], horizon] + (trial.value or 0.0),
        }
        for trial in ended
    ]


if __name__ == "__main__":
    found = [*trials("journal.log"), *trials("tuned-journal.log", TUNED)]
    found += trials("whole-journal.log", TUNED, 3000)
    found.sort(key=lambda row: (row["horizon"], -float(str(row["return"]))))
    print(json.dumps(found, indent=1))
