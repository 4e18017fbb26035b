"""Cards of the gallery, made from results/gallery.json: no number is typed in."""

import pandas as pd
from tables import results_part, show

CARDS = results_part("gallery/cards")


def card(name: str) -> str:
    """Return what there is to know of a packaged controller on its road."""
    found = CARDS[name]
    changes = "".join(f" --set {key}={value}" for key, value in found["changes"].items())
    command = f"unjam drive {found['road']} -d human -d unjam:{name}{changes} --test-seeds -n {found['seeds']}"
    domain = found["domain"]
    certified = (
        ", ".join(f"{key.replace('_', ' ')} {low:.1f} to {high:.1f}" for key, (low, high) in domain.items())
        if domain
        else "none: the file has no certificate (unjam certify), nothing is proven of it"
    )
    stability = {"string stability": found["string_stability"]} if found["string_stability"] else {}
    rows = {
        **stability,
        "compared with the human baseline": f"{found['compared with the human baseline']}; {found['seeds']} seeds",
        "minimum time gap": f"{found['min_time_gap']:.2f} s",
        "maximum braking": f"{found['max_braking']:.1f} m/s²",
        "feasible": found["feasibility"],
        "made for": found["made_for"],
        "certified domain": certified,
        "see it": f"`{command}`",
    }
    return show(pd.DataFrame({"": rows}), index=True)
