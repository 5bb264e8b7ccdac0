# SPDX-License-Identifier: Apache-2.0
"""Writes bags/scenarios/fifty_rooms.yaml: 50 rooms along two corridors that two passages join to a ring.

    python benchmarks/simulation/fifty_rooms.py [--agents N --seconds S -o FILE]

The path goes into every room, round once, and out again; along the first corridor, through the passage, back along
the second and home. It closes one large loop and fifty small ones.

With ``--agents`` the path is cut into stretches, one for each agent, that overlap by half: every place but the ends is
walked by two. All set out at the same time.
"""

from __future__ import annotations

import argparse
import math
from itertools import pairwise
from pathlib import Path

SCENARIO = Path(__file__).resolve().parents[2] / "bags/scenarios/fifty_rooms.yaml"
STYLES = ("office", "lab", "conference", "workshop", "store")
WIDTH, DEPTH, WALL, CORRIDOR = 5.0, 5.0, 0.2, 2.0
PITCH = WIDTH + WALL
COLUMNS = 13
"""Rooms of a row; the fourth and the second row have one less, which makes fifty."""
SPEED = 0.9

Point = list[float]


def rows() -> list[tuple[float, float, int]]:
    """(y of the near wall, direction away from the corridor, number of rooms) of the four rows."""
    second = CORRIDOR + 2 * WALL + 2 * (DEPTH + WALL)
    return [
        (-WALL, -1.0, COLUMNS),
        (CORRIDOR + WALL, 1.0, COLUMNS - 1),
        (second - WALL, -1.0, COLUMNS - 1),
        (second + CORRIDOR + WALL, 1.0, COLUMNS),
    ]


def corridor(name: str, x: tuple[float, float], y: tuple[float, float]) -> str:
    """Line of a corridor."""
    extent = f"x: [{x[0]:.1f}, {x[1]:.1f}], y: [{y[0]:.1f}, {y[1]:.1f}]"
    return f"  - {{name: {name}, {extent}, height: 2.6, style: corridor}}"


def plan() -> tuple[list[str], list[str]]:
    """Lines of the rooms and of the doorways."""
    length, second = COLUMNS * PITCH, rows()[2][0] + WALL
    rooms = [
        corridor("corridor_1", (0.0, length), (0.0, CORRIDOR)),
        corridor("corridor_2", (0.0, length), (second, second + CORRIDOR)),
    ]
    doors = []
    for x0, x1 in ((-CORRIDOR - WALL, -WALL), (length + WALL, length + WALL + CORRIDOR)):
        rooms.append(corridor("passage", (x0, x1), (0.0, second + CORRIDOR)))
        side = -WALL / 2 if x0 < 0 else length + WALL / 2
        doors += [f"  - {{at: [{side:.2f}, {y:.2f}], width: 1.4}}" for y in (1.0, second + 1.0)]
    number = 0
    for near, direction, count in rows():
        for column in range(count):
            x0, far = column * PITCH, near + direction * DEPTH
            y0, y1 = sorted((near, far))
            rooms.append(
                f"  - {{name: room_{number}, x: [{x0:.1f}, {x0 + WIDTH:.1f}], y: [{y0:.1f}, {y1:.1f}], "
                f"style: {STYLES[number % len(STYLES)]}}}"
            )
            doors.append(f"  - {{at: [{x0 + WIDTH / 2:.2f}, {near - direction * WALL / 2:.2f}], width: 1.1}}")
            number += 1
    return rooms, doors


def visit(column: int, near: float, direction: float, heading: float) -> list[Point]:
    """Into a room, once round its middle, and out; ``heading`` +1 or -1 along the corridor."""
    x, h = column * PITCH + WIDTH / 2, heading
    steps = [(-0.1, -0.1), (0.1, 1.3), (0.9, 2.3), (0.1, 3.3), (-0.9, 2.4), (-0.2, 1.3), (0.1, -0.1)]
    return [[x + h * across, near + direction * away] for across, away in steps]


def walk() -> list[Point]:
    """Way points of the whole path."""
    length, second = COLUMNS * PITCH, rows()[2][0] + WALL
    points: list[Point] = [[0.4, 1.0]]
    for column in range(COLUMNS):
        for near, direction, count in rows()[:2]:
            if column < count:
                points += [*visit(column, near, direction, 1.0), [column * PITCH + WIDTH / 2 + 0.8, 1.0]]
        points.append([(column + 1) * PITCH - 0.4, 1.0])
    east, west = length + WALL + 1.0, -WALL - 1.0
    points += [[length + 0.1, 1.0], [east, 1.8], [east, second / 2], [east, second + 0.2], [length + 0.1, second + 1.0]]
    for column in reversed(range(COLUMNS)):
        for near, direction, count in rows()[2:]:
            if column < count:
                points += [*visit(column, near, direction, -1.0), [column * PITCH + WIDTH / 2 - 0.8, second + 1.0]]
        points.append([column * PITCH + 0.4, second + 1.0])
    return [
        *points,
        [-0.1, second + 1.0],
        [west, second + 0.2],
        [west, second / 2],
        [west, 1.8],
        [-0.1, 1.0],
        [0.4, 1.0, 0.0],
    ]


def stretch(points: list[Point], begin: float, length: float) -> list[Point]:
    """The part of a path from ``begin`` (m along it) on, so long; ends between way points are interpolated."""
    out: list[Point] = []
    at = 0.0
    for a, b in pairwise(points):
        step = math.dist(a[:2], b[:2])
        for where in (begin, begin + length):
            if at <= where < at + step:
                share = (where - at) / step
                out.append([a[k] + share * (b[k] - a[k]) for k in range(2)])
        at += step
        if begin < at < begin + length:
            out.append(b[:2])
    return out


def agent_lines(paths: dict[str, list[Point]]) -> list[str]:
    """Lines of the agents and their way points."""
    lines = []
    for name, points in paths.items():
        lines += [f"  - name: {name}", "    motion: rig"] if name else ["  - motion: rig"]
        lines += ["    height: 1.2", "    path:", *(f"      - [{', '.join(f'{c:.2f}' for c in p)}]" for p in points)]
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=24.0, help="that each of several agents walks")
    parser.add_argument("-o", "--output", type=Path, default=SCENARIO, metavar="FILE")
    arguments = parser.parse_args()
    if arguments.agents > 1 and arguments.output == SCENARIO:
        parser.error("several agents are a scenario of their own: name its file with -o")
    rooms, doors = plan()
    points = walk()
    length = sum(math.dist(a[:2], b[:2]) for a, b in pairwise(points))
    if arguments.agents == 1:
        points[0].append(0.0)
        paths, seconds = {"": points}, length / SPEED
        description = f"A building of 50 rooms, every one visited, about {length:.0f} m; for scale"
    else:
        seconds, each = arguments.seconds, SPEED * arguments.seconds
        if (arguments.agents + 1) * each / 2 > length:
            parser.error(f"the path of {length:.0f} m is too short for {arguments.agents} agents of {each:.0f} m")
        paths = {f"agent_{k}": stretch(points, k * each / 2, each) for k in range(arguments.agents)}
        description = f"{arguments.agents} agents in a building of 50 rooms, {each:.0f} m each; for scale"
    lines = [
        f"description: {description}",
        "# Written by benchmarks/simulation/fifty_rooms.py.",
        "seed: 950",
        "rate: 10.0",
        f"frames: {int(seconds * 10)}",
        "rooms:",
        *rooms,
        "doorways:",
        *doors,
        "agents:",
        *agent_lines(paths),
    ]
    arguments.output.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"{arguments.output}: {len(rooms)} rooms with corridors, {length:.0f} m")


if __name__ == "__main__":
    main()
