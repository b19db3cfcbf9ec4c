"""What was identified: entries for the vehicle file, and a page of plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from perch_core.vehicle import Vehicle
from perch_eval.identification.answers import Answer, answers_figure
from perch_eval.identification.fit import Found


def entries(found: Sequence[Found], vehicle: Vehicle, base: str, name: str, flight: str, voltages: Sequence[float] = ()) -> str:
    """A vehicle file that extends `base` by what was identified; all else stays as it is there, with the reason in a comment.

    Args:
        found: what was identified.
        vehicle: as it was known so far.
        base: its name, or its file.
        name: of the identified vehicle.
        flight: of which it was identified, in words.
        voltages: of the flights [V], the first one that of the thrust curve.
    """
    lines: list[str] = []
    for key in dict.fromkeys(one.key.split("[")[0] for one in found):
        group = [one for one in found if one.key.split("[")[0] == key]
        owner = vehicle.actuation if key.startswith("actuation.") else vehicle
        field = key.split(".")[-1]
        if key == "actuation.battery.exponent" and not group[0].refused:
            text = f"{{reference: {voltages[0]:g}, exponent: {group[0].value:.4g}, range: [{min(voltages):g}, {max(voltages):g}]}}"
            lines.append(f"  battery: {text}  # exponent +- {group[0].sigma:.2g}")
        old = getattr(owner, field, None)
        if old is None:
            continue
        new = [old[i] if one.refused else one.value for i, one in enumerate(group)] if isinstance(old, tuple) else group[0].value
        told = not all(one.refused for one in group)
        axes = [f"{'xyz'[i]} " if len(group) > 1 else "" for i in range(len(group))]
        sigmas = "; ".join(f"{axis}+- {one.sigma:.2g} {one.unit}".rstrip() for axis, one in zip(axes, group) if not one.refused)
        text = f"[{', '.join(f'{x:.4g}' for x in new)}]" if isinstance(new, list) else f"{new:.5g}"
        indent = "  " if key.startswith("actuation.") else ""
        lines += [f"{indent}# {field}: {axis}not identified: {one.refused}" for axis, one in zip(axes, group) if one.refused]
        if told:
            lines.append(f"{indent}{field}: {text}".ljust(45) + f"# {sigmas}")
    mine, inner = [line for line in lines if not line.startswith("  ")], [line for line in lines if line.startswith("  ")]
    head = [f"# Identified by scripts/identify.py, with standard deviations. Of: {flight}", f"extends: {base}", f"name: {name}"]
    return "\n".join([*head, *mine, *(["actuation:", f"  type: {vehicle.actuation.type}", *inner] if inner else [])]) + "\n"


def draw(file: Path, found: Sequence[Found], answers: Sequence[Answer], title: str) -> None:
    """The answers, and below them what was found."""
    figure = answers_figure([replace(answer, t=answer.t - answer.t[0]) for answer in answers])
    figure.suptitle(title)
    figure.supxlabel("\n".join(map(str, found)), family="monospace", fontsize=8, x=0.02, ha="left")
    figure.savefig(file, dpi=95)
