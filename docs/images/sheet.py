"""Blocks, arrows and notes on a page, of which the figures of the networks consist."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

INK, PALE = "#22262E", "#5A6270"
Point = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Block:
    """A block with a title and smaller lines below it; x and y are its center."""

    x: float
    y: float
    width: float
    height: float
    title: str
    lines: Sequence[str] = ()
    color: str = PALE

    @property
    def left(self) -> Point:
        return self.x - self.width / 2, self.y

    @property
    def right(self) -> Point:
        return self.x + self.width / 2, self.y

    @property
    def top(self) -> Point:
        return self.x, self.y + self.height / 2

    @property
    def bottom(self) -> Point:
        return self.x, self.y - self.height / 2


@dataclasses.dataclass
class Sheet:
    """Blocks, arrows and notes of one figure, in inches."""

    width: float
    height: float
    blocks: list[Block] = dataclasses.field(default_factory=list)
    arrows: list[tuple[list[Point], str]] = dataclasses.field(default_factory=list)
    notes: list[tuple[float, float, str]] = dataclasses.field(default_factory=list)

    def block(self, *place: float, title: str, color: str, lines: Any = ()) -> Block:
        """Add a block; `place` is x, y, width, height."""
        made = Block(*place, title, tuple(lines), color)
        self.blocks.append(made)
        return made

    def arrow(self, *way: Point, color: str = PALE) -> None:
        """Add an arrow along points."""
        self.arrows.append((list(way), color))

    def draw(self) -> Figure:
        """Return the figure."""
        figure = Figure(figsize=(self.width, self.height), dpi=150, facecolor="white")
        axes = figure.add_axes(
            (0, 0, 1, 1), xlim=(0, self.width), ylim=(0, self.height)
        )
        axes.axis("off")
        for way, color in self.arrows:
            axes.plot(*zip(*way[:-1], strict=True), color=color, lw=1.2, zorder=1)
            tip = FancyArrowPatch(
                *way[-2:],
                arrowstyle="-|>",
                mutation_scale=9,
                shrinkA=0,
                shrinkB=0,
                color=color,
                lw=1.2,
                zorder=1,
            )
            axes.add_patch(tip)
        for block in self.blocks:
            _draw_block(axes, block)
        for x, y, text in self.notes:
            axes.text(x, y, text, size=8.5, color=PALE, va="center", linespacing=1.5)
        return figure


def _draw_block(axes: Any, block: Block) -> None:
    frame = FancyBboxPatch(
        (block.x - block.width / 2, block.y - block.height / 2),
        block.width,
        block.height,
        boxstyle="round,pad=0,rounding_size=0.06",
        facecolor="white",
        edgecolor=block.color,
        linewidth=1.4,
        zorder=2,
    )
    axes.add_patch(frame)
    rise = 0.165
    y = block.y + rise * len(block.lines) / 2
    place = {"ha": "center", "va": "center", "zorder": 3}
    axes.text(block.x, y, block.title, size=9, weight="bold", color=INK, **place)
    for number, line in enumerate(block.lines, 1):
        axes.text(block.x, y - rise * number, line, size=7.5, color=PALE, **place)
