"""An autopilot's log, aligned with its bag, as page data."""

from typing import Any

from uav_dc_ros.messages import printable
from uav_dc_ros.recordings.flight_log.aligned import AlignedLog
from uav_dc_ros.recordings.thinning import spread

POINTS_MAX = 2000  # of a curve
EVENTS_MAX = 300  # rows
CURVES = {"altitude_m": 2, "deviation_m": 3, "battery_v": 3, "battery_a": 2}  # decimals


def log_data(aligned: AlignedLog) -> dict[str, Any]:
    """Page data; times are seconds after the bag's first message."""
    rows, events, fit = aligned.rows(), aligned.events(), aligned.fit
    shown = spread(len(rows["time_s"]), POINTS_MAX).tolist()
    ahead_s = aligned.ahead_of_gps_s

    def curve(name: str, decimals: int) -> list[float | None]:
        values = (rows[name][i] for i in shown)
        return [None if value is None else round(value, decimals) for value in values]

    return {
        "file": printable(aligned.path.name),
        "autopilot": aligned.log.autopilot,
        "offset_s": round(fit.offset_s, 3),
        "rms_m": round(fit.rms_m, 3),
        "overlap_s": round(fit.overlap_s, 1),
        "explained": fit.explained,
        "ahead_of_gps_s": None if ahead_s is None else round(ahead_s, 3),
        "s": curve("time_s", 2),
        **{name: curve(name, decimals) for name, decimals in CURVES.items()},
        "events": [{"s": round(at_s, 2), "text": printable(text)} for at_s, text in events[:EVENTS_MAX]],
        "events_total": len(events),
    }
