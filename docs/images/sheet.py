"""Blocks and arrows as an SVG file, of which the figures of the networks consist.

All text is white on a block of its own color and the page is transparent, so that the figures can
be read on a bright and on a dark page, whichever of them a site shows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from xml.sax.saxutils import escape

Point = tuple[float, float]

ARROW_COLOR = "#848d97"  # at least 3:1 on white and on black
_STYLE = f"""
text {{ font: 12px system-ui, "Segoe UI", Helvetica, Arial, "DejaVu Sans", sans-serif; fill: #fff }}
text.title {{ font-weight: bold; font-size: 13px }}
text.center {{ text-anchor: middle }}
polyline {{ fill: none; stroke: {ARROW_COLOR}; stroke-width: 1.8 }}
"""
_MARKER = (
    '<marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" '
    'markerHeight="8" orient="auto" markerUnits="userSpaceOnUse">'
    f'<path d="M0 0 10 5 0 10z" fill="{ARROW_COLOR}"/></marker>'
)
_LOCK = (
    '<path transform="translate({x:g} {y:g})" fill="none" stroke="#fff" stroke-width="1.6" '
    'd="M0 6h10v7h-10zM2 6v-3a3 3 0 0 1 6 0v3"/>'
)
_LINE_HEIGHT = 15.0


@dataclasses.dataclass(frozen=True)
class Block:
    """A block with a title and lines below it; x and y are its center, y points down."""

    x: float
    y: float
    width: float
    height: float
    title: str
    color: str
    lines: Sequence[str] = ()
    is_frozen: bool = False

    @property
    def left(self) -> Point:
        return self.x - self.width / 2, self.y

    @property
    def right(self) -> Point:
        return self.x + self.width / 2, self.y

    @property
    def top(self) -> Point:
        return self.x, self.y - self.height / 2

    @property
    def bottom(self) -> Point:
        return self.x, self.y + self.height / 2

    def svg(self) -> str:
        """Returns the elements of the block."""
        x, y = self.left[0], self.top[1]
        dashes = f' stroke="{ARROW_COLOR}" stroke-width="3" stroke-dasharray="6 3"'
        dashes = dashes if self.is_frozen else ""
        parts = [
            f'<rect x="{x:g}" y="{y:g}" width="{self.width:g}" height="{self.height:g}" '
            f'rx="6" fill="{self.color}"{dashes}/>'
        ]
        base = self.y + 4 - _LINE_HEIGHT * len(self.lines) / 2
        for number, line in enumerate((self.title, *self.lines)):
            name = "center" if number else "center title"
            place = f'x="{self.x:g}" y="{base + number * _LINE_HEIGHT:g}"'
            parts.append(f'<text class="{name}" {place}>{escape(line)}</text>')
        if self.is_frozen:
            parts.append(_LOCK.format(x=x + self.width - 18, y=y + 7))
        return "\n".join(parts)


@dataclasses.dataclass
class Sheet:
    """Blocks and arrows of one figure, in pixels of a page of this width."""

    width: float
    height: float
    description: str
    blocks: list[Block] = dataclasses.field(default_factory=list)
    arrows: list[Sequence[Point]] = dataclasses.field(default_factory=list)

    def block(
        self,
        x: float,
        y: float,
        *,
        title: str,
        color: str,
        lines: Sequence[str] = (),
        width: float = 168.0,
        height: float = 66.0,
        is_frozen: bool = False,
    ) -> Block:
        """Adds a block."""
        made = Block(x, y, width, height, title, color, tuple(lines), is_frozen)
        self.blocks.append(made)
        return made

    def arrow(self, *way: Point) -> None:
        """Adds an arrow along points."""
        self.arrows.append(way)

    def svg(self) -> str:
        """Returns the figure as an SVG document."""
        size = f'viewBox="0 0 {self.width:g} {self.height:g}" width="{self.width:g}"'
        lines = [
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img">',
            f"<title>{escape(self.description)}</title>",
            f"<style>{_STYLE}</style><defs>{_MARKER}</defs>",
        ]
        for way in self.arrows:
            points = " ".join(f"{x:g},{y:g}" for x, y in way)
            lines.append(f'<polyline points="{points}" marker-end="url(#tip)"/>')
        lines += [block.svg() for block in self.blocks]
        return "\n".join((*lines, "</svg>", ""))
