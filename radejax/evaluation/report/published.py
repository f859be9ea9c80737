"""Every number in the result tables of the RADE-Net and DinoRADE papers.

Values are average precisions in percent, None where a paper prints "-". What a paper
does not say is marked so; "floor" values (0.99 = 1/101) are kept as printed.

References:
    RADE-Net: Leitgeb et al., "RADE-Net: Robust Attention Network for Radar-Only Object
    Detection in Adverse Weather", tables I to III.
    DinoRADE: Leitgeb et al., arXiv:2604.08074, tables 1 to 4.
"""

from __future__ import annotations

import dataclasses

WEATHERS = ("normal", "overcast", "fog", "rain", "sleet", "lightsnow", "heavysnow")
CONDITIONS = ("all", *WEATHERS)

AUTHORS_PROTOCOL = "coco101"
"""RADE-Net's and DinoRADE's own rows: RADE-Net's evaluator, 101 recall levels, frames
without the class left out (the printed 0.99 is its floor 1/101)."""

COPIED = "not stated (copied from earlier work)"


@dataclasses.dataclass(frozen=True)
class PublishedRow:
    """One row of a published table.

    Attributes:
        paper: "RADE-Net" or "DinoRADE".
        table: Number of the table as printed.
        method: Name of the row.
        modality: L lidar, C camera, R radar; "" where the table has no such column.
        label_version: K-Radar label revision.
        protocol: Evaluation protocol as far as known.
        space: "3d" or "bev".
        iou: IoU threshold.
        values: AP by (class, condition); the class "mean" is the paper's mAP.
        note: What a reader should know.
    """

    paper: str
    table: str
    method: str
    modality: str
    label_version: str
    protocol: str
    space: str
    iou: float
    values: dict[tuple[str, str], float | None]
    note: str = ""

    @property
    def source(self) -> str:
        """Paper and table."""
        return f"{self.paper}, Table {self.table}"

    def get(self, cls: str, condition: str = "all") -> float | None:
        """The printed value, None where there is none."""
        return self.values.get((cls, condition))


def _number(text: str) -> float | None:
    return None if text == "-" else float(text)


def _weather_row(numbers: str, cls: str = "Sedan") -> dict:
    """Values of a row "Total Normal Overcast ... Heavy Snow"."""
    values = [_number(text) for text in numbers.split()]
    return {
        (cls, condition): value
        for condition, value in zip(CONDITIONS, values, strict=True)
    }


_LABELS_I = "v1.1 (the paper does not say; the authors' release)"
_LABELS_II = "v2.1 (the paper does not say; DinoRADE, Table 3, prints the same totals)"

_TABLE_I = """
3d|L|Voxel-RCNN|46.4 81.8 69.6 48.8 47.1 46.9 54.8 37.2
3d|L|CasA|50.9 82.2 65.6 44.4 53.7 49.9 62.7 36.9
3d|L|TED-S|51.0 74.3 68.8 45.7 53.6 44.8 63.4 36.7
3d|LC|VPFNet|52.2 81.2 76.3 46.3 53.7 44.9 63.1 36.9
3d|LC|TED-M|52.3 77.2 69.7 47.4 54.3 45.2 64.3 36.3
3d|LC|MixedFusion|55.1 84.5 76.6 53.3 55.3 49.6 68.7 44.9
3d|RC|EchoFusion|47.4 51.5 65.4 55.0 43.2 14.2 53.4 40.2
3d|RC|DPFT|56.1 55.7 59.4 63.1 49.0 51.6 50.5 50.5
3d|R|RTNH|47.4 49.9 56.7 52.8 42.0 41.5 50.6 44.5
3d|R|RTNH+|57.6 - - - - - - -
3d|R|RADE-Net|64.1 60.7 72.0 85.4 55.4 63.6 68.6 67.6
bev|R|RTNH|58.4 58.5 64.2 76.2 58.4 60.3 57.6 56.6
bev|R|RTNH+|65.7 - - - - - - -
bev|R|RADE-Net|68.7 65.2 74.6 91.3 63.1 67.9 74.1 68.7
"""

_TABLE_1 = """
3d|L|Voxel-RCNN|46.4 81.8 69.6 48.8 47.1 46.9 54.8 37.2
3d|L|CasA|50.9 82.2 65.6 44.4 53.7 49.9 62.7 36.9
3d|L|TED-S|51.0 74.3 68.8 45.7 53.6 44.8 63.4 36.7
3d|R|RTNH|47.4 49.9 56.7 52.8 42.0 41.5 50.6 44.5
3d|R|RTNH+|57.6 - - - - - - -
3d|R|RADE-Net|66.7 66.3 74.5 82.1 57.2 69.4 63.9 68.9
3d|LC|VPFNet|52.2 81.2 76.3 46.3 53.7 44.9 63.1 36.9
3d|LC|TED-M|52.3 77.2 69.7 47.4 54.3 45.2 64.3 36.3
3d|LC|MixedFusion|55.1 84.5 76.6 53.3 55.3 49.6 68.7 44.9
3d|RC|EchoFusion|47.4 51.5 65.4 55.0 43.2 14.2 53.4 40.2
3d|RC|DPFT|56.1 55.7 59.4 63.1 49.0 51.6 50.5 50.5
3d|RC|WRCFormer|58.7 55.9 59.7 70.1 52.2 54.7 59.2 54.0
3d|RC|DinoRADE|70.8 72.8 84.9 69.7 68.4 58.4 70.4 65.0
"""

# Total, Normal, Fog, Rain, Sleet, Light Snow, Heavy Snow; 3D and BEV in turn.
_TABLE_II = """
Sedan|56.75 63.21 55.10 61.29 83.09 89.13 49.11 58.69 39.96 44.45 62.10 72.22 61.82 63.33
Bus or Truck|40.99 48.29 37.25 40.77 - - 1.05 1.05 14.12 17.99 68.96 72.56 65.94 85.94
Pedestrian|5.40 6.79 0.99 0.99 15.43 19.94 0.99 0.99 1.40 1.60 - - - -
Bicycle|1.49 1.49 1.49 1.49 - - - - - - - - - -
mean|26.16 29.95 23.71 26.13 49.26 54.53 17.05 20.24 18.52 21.53 65.53 72.39 63.88 74.63
"""
_CONDITIONS_II = ("all", "normal", "fog", "rain", "sleet", "lightsnow", "heavysnow")

# Total, Sedan, Bus or Truck, Pedestrian, Motorcycle, Bicycle; 3D and BEV in turn.
_TABLE_2 = """
all|36.99 39.61 71.38 75.32 54.92 58.93 33.01 38.12 3.77 3.77 21.89 21.89
normal|29.04 30.08 71.52 74.13 46.61 49.17 0.99 0.99 3.77 3.77 22.32 22.32
overcast|70.89 74.33 74.20 75.16 67.57 73.51 - - - - - -
fog|67.41 75.68 83.84 89.91 - - 50.98 61.46 - - - -
rain|24.10 25.97 71.32 76.92 0.99 0.99 0.00 0.00 - - - -
sleet|47.14 49.63 66.89 70.43 44.69 46.41 29.85 32.04 - - - -
lightsnow|70.73 76.63 69.29 76.72 72.17 76.55 - - - - - -
heavysnow|71.93 76.34 66.43 66.75 77.42 85.94 - - - - - -
"""
_TABLE_3 = """
R|RADE-Net|20.93 23.96 56.75 63.21 40.99 48.29 5.40 6.79 0.00 0.00 1.49 1.49
RC|DPFT|11.65 13.54 38.99 41.02 17.60 20.55 1.66 6.14 0.00 0.00 0.00 0.00
RC|DinoRADE|36.99 39.61 71.38 75.32 54.92 58.93 33.01 38.12 3.77 3.77 21.89 21.89
"""
_CLASSES_2 = ("mean", "Sedan", "Bus or Truck", "Pedestrian", "Motorcycle", "Bicycle")

ABLATION_COLUMNS = (
    "Feature Expansion",
    "Input Stem",
    "Dilated Neck",
    "Expanded Heads",
    "CBAM",
    "Base",
)
"""Columns of RADE-Net's Table III; a row is described by the columns it ticks."""

# Ticks in the order of the columns, then AP 3D and BEV at IoU 0.3, then at IoU 0.5. The
# fourth and the fifth row tick the same columns in the paper as printed.
_TABLE_III = """
.....x|57.96 63.98 32.85 56.18
....xx|55.13 62.88 27.65 50.99
...xxx|58.35 64.70 32.73 55.98
..xxxx|59.81 66.32 35.31 57.01
..xxxx|64.06 68.71 39.02 61.64
.xxxxx|63.47 69.05 37.09 60.82
x.xxxx|63.12 67.92 38.04 60.22
"""

_TABLE_4 = """
R|61.65 66.68
R+C|69.61 74.96
R+C+W|71.38 75.32
R+C*+W|68.43 72.42
"""


def _lines(table: str) -> list[list[str]]:
    return [line.split("|") for line in table.strip().splitlines()]


def _sedan_weather(paper: str, number: str, table: str, labels: str) -> list:
    rows = []
    for space, modality, method, numbers in _lines(table):
        own = method in ("RADE-Net", "DinoRADE")
        rows.append(
            PublishedRow(
                paper,
                number,
                method,
                modality,
                labels,
                AUTHORS_PROTOCOL if own else COPIED,
                space,
                0.3,
                _weather_row(numbers),
            )
        )
    return rows


def _in_turn(numbers: str, keys: list[tuple[str, str]]) -> dict[str, dict]:
    """Values of a row that prints 3D and BEV in turn."""
    values = [_number(text) for text in numbers.split()]
    return {
        "3d": dict(zip(keys, values[::2], strict=True)),
        "bev": dict(zip(keys, values[1::2], strict=True)),
    }


def _merge(parts: list[dict[str, dict]]) -> dict[str, dict]:
    merged: dict[str, dict] = {"3d": {}, "bev": {}}
    for part in parts:
        for space, values in part.items():
            merged[space].update(values)
    return merged


def _table_ii() -> list[PublishedRow]:
    merged = _merge(
        [
            _in_turn(numbers, [(cls, condition) for condition in _CONDITIONS_II])
            for cls, numbers in _lines(_TABLE_II)
        ]
    )
    note = (
        "no column for overcast and no row for Motorcycle; the mean is over 4 classes"
    )
    return [
        PublishedRow(
            "RADE-Net",
            "II",
            "RADE-Net",
            "R",
            _LABELS_II,
            AUTHORS_PROTOCOL,
            space,
            0.3,
            values,
            note,
        )
        for space, values in merged.items()
    ]


def _table_2() -> list[PublishedRow]:
    merged = _merge(
        [
            _in_turn(numbers, [(cls, condition) for cls in _CLASSES_2])
            for condition, numbers in _lines(_TABLE_2)
        ]
    )
    note = "0.99 is the floor of the 101-point interpolation, 1/101"
    return [
        PublishedRow(
            "DinoRADE",
            "2",
            "DinoRADE",
            "RC",
            "v2.1",
            AUTHORS_PROTOCOL,
            space,
            0.3,
            values,
            note,
        )
        for space, values in merged.items()
    ]


def _table_3() -> list[PublishedRow]:
    rows = []
    for modality, method, numbers in _lines(_TABLE_3):
        note = "retrained for five classes by DinoRADE's authors" * (method == "DPFT")
        merged = _in_turn(numbers, [(cls, "all") for cls in _CLASSES_2])
        rows += [
            PublishedRow(
                "DinoRADE",
                "3",
                method,
                modality,
                "v2.1",
                AUTHORS_PROTOCOL,
                space,
                0.3,
                values,
                note,
            )
            for space, values in merged.items()
        ]
    return rows


def _table_iii() -> list[PublishedRow]:
    rows = []
    for index, (ticks, numbers) in enumerate(_lines(_TABLE_III)):
        ticked = [
            name
            for name, tick in zip(ABLATION_COLUMNS, ticks, strict=True)
            if tick == "x"
        ]
        method = " + ".join(reversed(ticked))
        note = ""
        if index in (3, 4):
            note = (
                "two rows of the paper tick the same columns; the second is the model"
            )
        values = [float(text) for text in numbers.split()]
        for value, space, iou in zip(
            values, ("3d", "bev") * 2, (0.3, 0.3, 0.5, 0.5), strict=True
        ):
            rows.append(
                PublishedRow(
                    "RADE-Net",
                    "III",
                    method,
                    "R",
                    _LABELS_I,
                    AUTHORS_PROTOCOL,
                    space,
                    iou,
                    {("Sedan", "all"): value},
                    note,
                )
            )
    return rows


def _table_4() -> list[PublishedRow]:
    return [
        PublishedRow(
            "DinoRADE",
            "4",
            method,
            "RC" if "C" in method else "R",
            "v2.1",
            AUTHORS_PROTOCOL,
            space,
            0.3,
            {("Sedan", "all"): float(value)},
            "C*: ResNet-50 instead of DINOv3" * ("*" in method),
        )
        for method, numbers in _lines(_TABLE_4)
        for space, value in zip(("3d", "bev"), numbers.split(), strict=True)
    ]


PUBLISHED: tuple[PublishedRow, ...] = (
    *_sedan_weather("RADE-Net", "I", _TABLE_I, _LABELS_I),
    *_table_ii(),
    *_table_iii(),
    *_sedan_weather("DinoRADE", "1", _TABLE_1, "v1.1"),
    *_table_2(),
    *_table_3(),
    *_table_4(),
)
"""All rows of all result tables of both papers."""


def published_rows(
    paper: str | None = None,
    table: str | None = None,
    *,
    method: str | None = None,
    space: str | None = None,
    iou: float | None = None,
) -> list[PublishedRow]:
    """The rows that match all given fields, in the order of the papers."""
    wanted = {
        "paper": paper,
        "table": table,
        "method": method,
        "space": space,
        "iou": iou,
    }
    return [
        row
        for row in PUBLISHED
        if all(
            value is None or getattr(row, key) == value for key, value in wanted.items()
        )
    ]
