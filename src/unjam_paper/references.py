"""Reference drivers that do not learn: experts with default and tuned parameters, and the human baseline."""

from unjam.controller import make_driver
from unjam.manifest import manifest
from unjam.measures.statistics import metric_estimate
from unjam.training.config import load_config
from unjam.training.evaluate import evaluate, raise_failures, save_evaluation
from unjam.training.seeds import make_test_seeds
from unjam.worlds.episode import can_drive
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.study import STUDY_ROADS, StudyFolder, Table
from unjam_paper.variants import MERGE_JAM_ABSORBER

REFERENCE_DRIVERS: dict[str, str] = {
    **{"human": "human", "zero": "constant", "constant +0.1": "constant:acceleration=0.1"},
    **{"PI (paper)": "pi:time_constant=0", "PI": "pi", "FollowerStopper": "follower-stopper"},
    **{"IDM": "idm", "ACC": "acc", "LACC": "lacc", "BCM": "bcm", "OVM": "ovm"},
    **{"pacer": "pacer", "varying pacer": "pacer:use_tuned=true"},
    "gentle varying pacer": "pacer:use_tuned=true,time_constant=1",
    **{"jam absorber": "jam-absorber", "closing jam absorber": MERGE_JAM_ABSORBER},
}
"""drivers of all roads: label, and name as in `unjam drive`"""
TUNED_REFERENCES: dict[str, dict[str, str]] = {
    "ring": {"tuned PI": "unjam:ring-tuned", "tuned gap PI": "unjam:ring-gap-tuned"},
    "ring-jammed": {"tuned gap PI": "unjam:ring-jammed-tuned"},
    "ring-5": {
        "tuned jam absorber": "jam-absorber:gap_gain=0.2656,speed_gain=0.9472,time_gap=0.7288,"
        "standstill_gap=8.556,extra_acceleration=0.4562"
    },
    "ring-11": {
        "tuned jam absorber": "jam-absorber:gap_gain=0.4263,speed_gain=1.443,time_gap=0.7305,"
        "standstill_gap=4.266,extra_acceleration=0.09394"
    },
    "figure-eight": {
        "tuned pacer": "pacer:lap_time=88.83,gap_gain=0.006993,target_gap=0.4577,time_constant=0.2108",
        "tuned varying pacer": "unjam:figure-eight-tuned",
    },
    "on-ramp": {"tuned jam-ahead": "unjam:on-ramp-tuned"},
}
"""drivers that `unjam tune` found with at least the steps of a training (results/tuned.json), by road; on the merge no
setting is feasible, so none is tuned"""
NON_EXPERTS = ("human", "zero", "constant +0.1")
"""reference drivers to which no residual is added"""


def road_references(road: str) -> dict[str, str]:
    """Return the reference drivers of a road: label, and name as in `unjam drive`."""
    return {**REFERENCE_DRIVERS, **TUNED_REFERENCES.get(road, {})}


def drive_references(road: str, study_folder: StudyFolder, workers: int) -> None:
    """Evaluate the reference drivers of a road on the test seeds of the trainings."""
    config = load_config(changes=STUDY_ROADS[road])
    scenario = config.make_scenario()
    drivers = {label: make_driver(name, scenario.control_step) for label, name in road_references(road).items()}
    drivers = {label: driver for label, driver in drivers.items() if can_drive(driver, scenario)}
    with WorkerPool(workers) as pool:
        evaluation = evaluate(scenario, drivers, make_test_seeds(config.evaluation.episodes), pool)
    raise_failures(evaluation)
    metadata = {"scenario": config.scenario, "manifest": manifest()}
    save_evaluation(study_folder.reference_folder(road), evaluation, metadata)


def best_expert(reference_rows: dict[str, Table], metric: str = "return") -> str:
    """Return the label of the expert with the largest mean of a metric."""
    experts = [label for label in reference_rows if label not in NON_EXPERTS]
    return max(experts, key=lambda label: metric_estimate(reference_rows[label], metric).mean)
