"""The experiments of the thesis, each repeated by one command: `rtcp experiment NAME`."""

from rtcp.telemetry.experiments.experiment import Experiment
from rtcp.telemetry.experiments.latency import LatencyExperiment
from rtcp.telemetry.experiments.motions import PicksExperiment, SquareExperiment, StepExperiment
from rtcp.telemetry.experiments.resources import ResourcesExperiment
from rtcp.telemetry.experiments.timing import CycleExperiment, DelaysExperiment
from rtcp.telemetry.experiments.tracking import TrackingExperiment

__all__ = [
    "EXPERIMENTS", "CycleExperiment", "DelaysExperiment", "Experiment", "LatencyExperiment", "PicksExperiment",
    "ResourcesExperiment", "SquareExperiment", "StepExperiment", "TrackingExperiment",
]  # fmt: skip

EXPERIMENTS: dict[str, type[Experiment]] = {
    kind.name: kind
    for kind in (
        CycleExperiment, DelaysExperiment, StepExperiment, SquareExperiment, PicksExperiment, LatencyExperiment,
        ResourcesExperiment, TrackingExperiment,
    )
}  # fmt: skip
"""Name -> experiment, in the order of `rtcp experiment all`."""
