"""Results as Markdown."""

from __future__ import annotations

from typing import Any

from benchmarks.lone import POINTS
from benchmarks.saved import title
from benchmarks.sweep import exponent
from benchmarks.targets import targets

Rows = list[dict[str, Any]]

SHORT = (
    ("chamfer_distance", "80 x 2048 x 2048"),
    ("chamfer_distance", "8 x 16384 x 2048"),
    ("earth_mover_distance", "8 x 2048"),
    ("farthest_point_sample", "2 x 16384 -> 2048"),
    ("splat_depth", "80 x 2048, 56 x 56"),
    ("splat_depth", "80 x 2048, 224 x 224"),
    ("sample_view", "80 x 2048, 56 x 56"),
    ("project", "80 x 2048"),
    ("reproject", "80 x 56 x 56"),
    ("front_constraint, chamfer", "80 x 2048, 56 x 56"),
    ("projection_loss", "80 x 2048, 56 x 56"),
)
"""Op and size of the rows that the README shows."""


def page(results: dict[str, Any]) -> str:
    """Every table of a run."""
    parts = [f"{title(results['machine'])}."]
    if results.get("interrupted"):
        parts.append("**Interrupted: a part of the tables.**")
    if rows := results.get("races"):
        parts += ["## Beside other libraries", race_table(rows)]
    if rows := results.get("sweep"):
        parts += ["## How times grow", sweep_table(rows)]
    if rows := results.get("lone"):
        parts += ["## Lone large clouds", lone_table(rows)]
    if rows := results.get("memory"):
        parts += ["## Peak extra memory", memory_table(rows)]
    if rows := results.get("dispatch"):
        parts += ["## What registration with torch costs", dispatch_table(rows)]
    if rows := results.get("train"):
        parts += ["## A training step", training_table(rows)]
    return "\n\n".join([*parts, "## Targets", targets_table(results)]) + "\n"


def markdown(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def race_line(rows: Rows) -> list[str]:
    """The cells of one race."""
    ours, *peers = rows
    cells = [
        f"{p['contender']} {p['ms']:.3g} ({p['times_ours']:.1f}x{', ' + p['remark'] if p['remark'] else ''})"
        for p in sorted(peers, key=lambda p: p["ms"])
    ]
    own = f"{ours['ms']:.3g}" + (f" ({ours['remark']})" if ours["remark"] else "")
    extra = "" if ours.get("extra_mb") is None else f"{ours['extra_mb']:.3g}"
    return [ours["op"], ours["size"], ours["direction"], own, "; ".join(cells), extra]


def races_of(rows: Rows) -> list[Rows]:
    """The rows of each race, ours first."""
    races: dict[tuple[str, str, str], Rows] = {}
    for row in rows:
        races.setdefault((row["op"], row["size"], row["direction"]), []).append(row)
    return list(races.values())


def race_table(rows: Rows) -> str:
    header = ["op", "size", "", "diffpoint, ms", "peers, ms (times ours)", "extra MB"]
    return markdown(header, [race_line(race) for race in races_of(rows)])


def short_table(rows: Rows) -> str:
    """For the README: milliseconds and the best peer, forward and with backward."""
    lines = []
    for op, size in SHORT:
        cells = []
        for direction in ("forward", "forward + backward"):
            race = [r for r in rows if (r["op"], r["size"], r["direction"]) == (op, size, direction)]
            peers = [r for r in race[1:] if not r["remark"].startswith(("approximates", "depth only"))]
            best = min(peers, key=lambda r: r["ms"], default=None)
            own = f"{race[0]['ms']:.3g}" if race else ""
            cells += [own, f"{best['times_ours']:.1f}x {best['contender']}" if best else ""]
        if any(cells):
            lines.append([f"`{op}`" if "," not in op else op, size, *cells])
    header = ["op", "size", "forward, ms", "best peer takes", "with backward, ms", "best peer takes"]
    return markdown(header, lines)


def sweep_table(rows: Rows) -> str:
    sizes = sorted({r["points"] for r in rows})
    lines = []
    for op in dict.fromkeys(r["op"] for r in rows):
        for batch in dict.fromkeys(r["batch"] for r in rows if r["op"] == op):
            times = {r["points"]: r["ms"] / batch for r in rows if (r["op"], r["batch"]) == (op, batch)}
            slope = exponent(rows, op, batch)
            cells = [f"{times[n]:.3g}" if n in times else "" for n in sizes]
            lines.append([op, str(batch), *cells, "" if slope is None else f"{slope:.2f}"])
    names = [f"{n // 1024}k" if n < 2**20 else f"{n // 2**20}M" for n in sizes]
    return "Milliseconds per cloud or pair, by N.\n\n" + markdown(
        ["op", "B", *names, "exponent from 16k"], lines
    )


def lone_table(rows: Rows) -> str:
    lines = [
        [r["op"], f"{r['one_ms']:.3g}", f"{r['all_ms']:.3g}", f"{r['one_ms'] / r['all_ms']:.2f}x"]
        for r in rows
    ]
    return f"Clouds and maps of about {POINTS:,} points or pixels.\n\n" + markdown(
        ["op", "one thread, ms", f"{rows[0]['threads']} threads, ms", "faster"], lines
    )


def memory_table(rows: Rows) -> str:
    lines = [
        [
            r["op"],
            f"{r['small_elements']:,}",
            f"{r['small_mb']:.2f}",
            f"{r['large_elements']:,}",
            f"{r['large_mb']:.2f}",
            f"{1e6 * r['large_mb'] / r['large_elements']:.1f}",
        ]
        for r in rows
    ]
    header = ["op", "points and pixels", "MB", "points and pixels", "MB", "bytes for each"]
    return markdown(header, lines)


def dispatch_table(rows: Rows) -> str:
    lines = [
        [
            r["op"],
            f"{r['bare_us']:.0f}",
            f"{r['registered_us']:.0f}",
            f"{r['registered_us'] - r['bare_us']:+.0f}",
        ]
        for r in rows
    ]
    return markdown(["op, 16 points", "bare autograd.Function, us", "torch operator, us", "more"], lines)


def training_table(rows: Rows) -> str:
    parts = list(dict.fromkeys(name for r in rows for name in r["shares"]))
    lines = [
        [
            r["profile"],
            str(r["stage"]),
            f"{r['ms']:.0f}",
            *(f"{r['shares'].get(name, 0):.0%}" for name in parts),
            f"{r['layer_share']:.0%}",
            *(
                "" if r.get(name) is None else f"{r[name]:.1f}x"
                for name in ("reference_ratio", "scipy_ratio")
            ),
        ]
        for r in rows
    ]
    header = [
        "profile",
        "stage",
        "ms a step",
        *parts,
        "layer in all",
        "with diffpoint.reference",
        "with scipy's assignment too",
    ]
    return markdown(header, lines)


def targets_table(results: dict[str, Any], reasons: dict[str, str] | None = None) -> str:
    """With `reasons`, by name, a last column for them."""
    words = {True: "met", False: "**not met**", None: "not measured"}
    header = ["target", "wanted", "measured", ""]
    lines = [[t.name, t.wanted, t.measured, words[t.met]] for t in targets(results)]
    if reasons is not None:
        header.append("why, and what was tried")
        lines = [[*line, reasons.get(line[0], "")] for line in lines]
    return markdown(header, lines)
