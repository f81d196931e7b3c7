"""Metrics for Prometheus at `/metrics`: state, cycle times, counters of the platform and of the panel itself."""

from __future__ import annotations

from collections.abc import Iterator

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rtcp.api import State
from rtcp.panel.live import Live


class PlatformCollector(Collector):
    """The newest state at each request.

    Args:
        live: follows the platform.
    """

    def __init__(self, live: Live) -> None:
        self._live = live

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics; without a platform only the one that says so."""
        status = self._live.status
        yield GaugeMetricFamily("rtcp_up", "Whether a platform runs.", value=float(status is not None))
        pages = sum(page.socket is not None for page in self._live.pages.values())
        yield GaugeMetricFamily("rtcp_panel_pages", "Pages of the panel that are open.", value=pages)
        if status is None:
            return
        raw = status.raw
        states = GaugeMetricFamily("rtcp_state", "1 for the state of the machine.", labels=["state"])
        for state in State:
            states.add_metric([state.name.lower()], float(state is status.state))
        yield states
        yield CounterMetricFamily("rtcp_cycles", "Cycles since the start.", value=raw["cycles"])
        yield CounterMetricFamily("rtcp_skipped_cycles", "Cycles skipped since the start.", value=raw["missed"])
        yield GaugeMetricFamily("rtcp_cycle_seconds", "Period of the cycle.", value=raw["cycle_ns"] * 1e-9)
        for part in ("wakeup", "exchange", "compute"):
            family = GaugeMetricFamily(
                f"rtcp_{part}_seconds", f"Percentiles of the {part} time of the last cycles.", labels=["quantile"]
            )
            for quantile, key in (("0.5", "p50"), ("0.99", "p99"), ("0.999", "p999"), ("1", "max")):
                family.add_metric([quantile], raw[f"{part}_us"][key] * 1e-6)
            yield family
        yield GaugeMetricFamily("rtcp_working_counter", "Working counter.", value=raw["wkc"]["actual"])
        yield GaugeMetricFamily(
            "rtcp_expected_working_counter", "Expected working counter.", value=raw["wkc"]["expected"]
        )
        if raw["dc"] is not None:
            yield GaugeMetricFamily(
                "rtcp_dc_offset_seconds", "Offset from the reference clock.", value=raw["dc"]["offset_ns"] * 1e-9
            )
        in_op = GaugeMetricFamily("rtcp_slave_in_op", "Whether a slave is in OP.", labels=["position", "name"])
        errors = CounterMetricFamily(
            "rtcp_slave_errors", "What the ports of a slave have counted.", labels=["position", "name", "kind", "port"]
        )
        lost = CounterMetricFamily("rtcp_slave_lost", "How often a slave has left OP.", labels=["position", "name"])
        for slave in raw["slaves"]:
            place = [str(slave["position"]), slave["name"]]
            in_op.add_metric(place, float(slave["state"] == "OP"))
            lost.add_metric(place, slave["lost"])
            for kind, counts in slave["errors"].items():
                for port, count in enumerate(counts):
                    errors.add_metric([*place, kind, str(port)], count)
        yield in_op
        yield lost
        yield errors
        for name, unit in (
            ("actual_position", "radians"),
            ("actual_velocity", "radians_per_second"),
            ("actual_torque", "newton_metres"),
        ):
            family = GaugeMetricFamily(
                f"rtcp_joint_{name.removeprefix('actual_')}_{unit}",
                f"{name.replace('_', ' ')} of a joint.",
                labels=["joint"],
            )
            for joint, value in zip(status.joint_names, raw["joints"][name], strict=True):
                family.add_metric([joint], value)
            yield family

        for key, first, unit in (
            ("pose", 0, "metres"), ("pose", 3, "radians"),
            ("velocity", 0, "metres_per_second"), ("velocity", 3, "radians_per_second"),
        ):  # fmt: skip
            family = GaugeMetricFamily(f"rtcp_tool_{key}_{unit}", f"Measured {key} of the tool.", labels=["axis"])
            for axis, value in zip("xyz", (raw["tool"] or {}).get(key, ())[first:], strict=False):
                family.add_metric([axis], value)
            yield family

        devices = GaugeMetricFamily(
            "rtcp_device_value", "What a slave that is no drive publishes.", labels=["device", "field", "unit"]
        )
        for device, fields in raw["devices"].items():
            for name, field in fields.items():
                if isinstance(field["value"], (int, float)):
                    devices.add_metric([device, name, field["unit"]], field["value"])
        yield devices


def exposition(live: Live) -> bytes:
    """Return the metrics in Prometheus' text format."""
    registry = CollectorRegistry()
    registry.register(PlatformCollector(live))
    ProcessCollector(namespace="rtcp_panel", registry=registry)
    return generate_latest(registry)
