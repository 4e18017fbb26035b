"""Cards of the gallery, made from results/gallery.json."""

import pandas as pd
from tables import results_part, show

CARDS = results_part("gallery/cards")


def card(name: str) -> str:
    """Return the card of a packaged controller: its results on its road, its domain, and the command to repeat them."""
    results = CARDS[name]
    changes = "".join(f" --set {key}={value}" for key, value in results["changes"].items())
    command = f"unjam drive {results['road']} -d human -d unjam:{name}{changes} --test-seeds -n {results['seeds']}"
    domain = results["domain"]
    certified = (
        ", ".join(f"{key.replace('_', ' ')} {low:.1f} to {high:.1f}" for key, (low, high) in domain.items())
        if domain
        else "none: the file has no certificate (unjam certify), nothing is proven of it"
    )
    stability = {"string stability": results["string_stability"]} if results["string_stability"] else {}
    rows = {
        **stability,
        "compared with the human baseline": f"{results['compared with the human baseline']}; {results['seeds']} seeds",
        "minimum time gap": f"{results['min_time_gap']:.2f} s",
        "maximum braking": f"{results['max_braking']:.1f} m/s²",
        "feasible": results["feasibility"],
        "made for": results["made_for"],
        "certified domain": certified,
        "see it": f"`{command}`",
    }
    return show(pd.DataFrame({"": rows}), index=True)
