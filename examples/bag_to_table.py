"""A bag as a table and a picture. Needs no ROS; the picture needs matplotlib (extra train).

python examples/bag_to_table.py bags/B
"""

import csv
import sys
from pathlib import Path

from matplotlib.figure import Figure

from uav_dc_ros import read_steps

bag = Path(sys.argv[1])
rows = []
for step in read_steps(bag):  # one after the other: a bag may be larger than the memory
    if step.rates is None or step.position_m is None:  # a message was lost on its way
        continue
    east_m, north_m, altitude_m = step.position_m
    rows.append(
        {
            "mission": step.mission,
            "step": step.step,
            "east_m": float(east_m),
            "north_m": float(north_m),
            "altitude_m": float(altitude_m),
            "sum_rate_bps": step.rates.sum_rate_bps,
            "users_collected": sum(step.rates.collected),
            "action": step.move.action if step.move else "",  # the last step has none
        }
    )

table = bag.with_name(f"{bag.name}.csv")
with table.open("w", newline="") as file:
    writer = csv.DictWriter(file, fieldnames=list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)

figure = Figure(figsize=(8, 4))
way, users = figure.subplots(1, 2)
for mission in sorted({row["mission"] for row in rows}):
    flown = [row for row in rows if row["mission"] == mission]
    way.plot([row["east_m"] for row in flown], [row["north_m"] for row in flown], marker=".")
    users.step([row["step"] for row in flown], [row["users_collected"] for row in flown], where="post")
way.set(xlabel="east, m", ylabel="north, m", aspect="equal")
users.set(xlabel="step", ylabel="users collected")
figure.tight_layout()
figure.savefig(bag.with_name(f"{bag.name}.png"))
print(f"{len(rows)} steps: {table}, {bag.name}.png beside it")
