"""The experiments of the thesis, each repeated by one command: `rtcp experiment NAME`."""

from rtcp.telemetry.experiments.experiment import Experiment
from rtcp.telemetry.experiments.latency import LatencyExperiment
from rtcp.telemetry.experiments.motions import SquareExperiment, StepExperiment
from rtcp.telemetry.experiments.oversampling import OversamplingExperiment
from rtcp.telemetry.experiments.picks import PicksExperiment
from rtcp.telemetry.experiments.resources import ResourcesExperiment
from rtcp.telemetry.experiments.temperature import TemperatureExperiment
from rtcp.telemetry.experiments.timing import CycleExperiment, DelaysExperiment
from rtcp.telemetry.experiments.tracking import TrackingExperiment
from rtcp.telemetry.experiments.user_trials import JoystickExperiment

__all__ = [
    "EXPERIMENTS", "CycleExperiment", "DelaysExperiment", "Experiment", "JoystickExperiment", "LatencyExperiment",
    "OversamplingExperiment", "PicksExperiment", "ResourcesExperiment", "SquareExperiment", "StepExperiment",
    "TemperatureExperiment", "TrackingExperiment",
]  # fmt: skip

EXPERIMENTS: dict[str, type[Experiment]] = {
    kind.name: kind
    for kind in (
        CycleExperiment, DelaysExperiment, StepExperiment, SquareExperiment, PicksExperiment, JoystickExperiment,
        LatencyExperiment, ResourcesExperiment, TrackingExperiment, TemperatureExperiment, OversamplingExperiment,
    )
}  # fmt: skip
"""Name -> experiment, in the order of `rtcp experiment all`, which leaves out the last two."""
