"""List what two searches tried on the jammed ring, from their journals: settings.py > settings.json."""

import json
from pathlib import Path

from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.study import load_study
from optuna.trial import TrialState

HERE = Path(__file__).parent
EXPERTS = {"unjam:ring-jammed-tuned": 739.0, "unjam:ring-gap-tuned": 591.3}
"""mean returns on the 32 validation seeds, of the progress of trials"""


def trials(journal: str, expert: str = "") -> list[dict[str, object]]:
    """Return the settings of all trials that ended, with what they had beyond their expert in validation."""
    study = load_study(study_name="search", storage=JournalStorage(JournalFileBackend(str(HERE / journal))))
    ended = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    return [
        {
            "search": journal,
            "trial": trial.number,
            "expert": expert or trial.params["expert"],
            **{key: value for key, value in trial.params.items() if key != "expert"},
            "beyond its expert": trial.value,
            "return": EXPERTS[expert or trial.params["expert"]] + (trial.value or 0.0),
        }
        for trial in ended
    ]


if __name__ == "__main__":
    found = [*trials("journal.log"), *trials("tuned-journal.log", "unjam:ring-jammed-tuned")]
    found.sort(key=lambda row: -float(str(row["return"])))
    print(json.dumps(found, indent=1))
