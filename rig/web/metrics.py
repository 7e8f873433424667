"""The server's numbers in the text format of Prometheus."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rig.web.requests import JobState

if TYPE_CHECKING:
    from rig.web.server import Server

QUANTILES: Final = (0.5, 0.99, 0.999)


class _Numbers(Collector):
    def __init__(self, server: "Server") -> None:
        self._server = server

    def collect(self) -> Iterator[Metric]:
        server, status, numbers = self._server, self._server.remote.status, self._server.remote.ask("numbers")
        yield GaugeMetricFamily("rig_bench_open", "Whether the bench is open.", float(bool(status.get("open"))))
        yield GaugeMetricFamily("rig_fault_latched", "Whether a fault is latched.", float(bool(status.get("fault"))))
        if (angle_deg := status.get("table_deg")) is not None:
            yield GaugeMetricFamily("rig_table_degrees", "Angle of the table.", angle_deg)
        if servo := status.get("servo"):
            yield GaugeMetricFamily("rig_servo_temperature_celsius", "Temperature.", servo["temperature_c"])
            yield GaugeMetricFamily("rig_servo_volts", "Supply voltage.", servo["voltage_v"])
        yield GaugeMetricFamily("rig_viewers", "Open live pictures.", server.remote.viewers)
        yield GaugeMetricFamily("rig_event_listeners", "Open streams of events.", server.hub.listeners)
        jobs = server.remote.ask("jobs")
        waiting = GaugeMetricFamily("rig_jobs", "Jobs by state.", labels=["state"])
        for state in JobState:
            waiting.add_metric([state.value], sum(job["state"] == state for job in jobs))
        yield waiting
        ended = CounterMetricFamily("rig_jobs_ended", "Jobs ended since the server started.", labels=["state"])
        for name, number in numbers["jobs_ended"].items():
            ended.add_metric([name], number)
        yield ended
        yield CounterMetricFamily("rig_stops", "Presses of STOP since the server started.", numbers["stops"])
        intervals = sorted(numbers["intervals_s"])
        if intervals:
            polls = GaugeMetricFamily(
                "rig_servo_poll_seconds", "Time between two readings of the servo in motion.", labels=["quantile"]
            )
            for quantile in QUANTILES:
                polls.add_metric([str(quantile)], intervals[min(int(quantile * len(intervals)), len(intervals) - 1)])
            yield polls


def metrics_text(server: "Server") -> bytes:
    """Return the numbers of a server."""
    registry = CollectorRegistry()
    registry.register(_Numbers(server))
    return generate_latest(registry)
