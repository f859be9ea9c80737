"""A second, slow implementation of every protocol, written from their descriptions.

One class, one space and one IoU threshold at a time, with Python loops over frames, boxes
and score thresholds, and shapely for the overlaps: nothing is shared with
`radejax.evaluation`, so that agreement means something.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import shapely


def footprint(box):
    """Polygon of a box x, y, z, l, w, h, yaw seen from above."""
    x, y, _, length, width, _, yaw = (float(v) for v in box)
    corners = []
    for along, across in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        u, v = along * length / 2, across * width / 2
        corners.append(
            (
                x + math.cos(yaw) * u - math.sin(yaw) * v,
                y + math.sin(yaw) * u + math.cos(yaw) * v,
            )
        )
    return shapely.Polygon(corners)


def overlap(a, b, space, z_center=0.5):
    """BEV or 3D IoU of two boxes."""
    area = footprint(a).intersection(footprint(b)).area
    area_a, area_b = a[3] * a[4], b[3] * b[4]
    if space == "bev":
        return area / (area_a + area_b - area)
    top = min(a[2] + (1 - z_center) * a[5], b[2] + (1 - z_center) * b[5])
    bottom = max(a[2] - z_center * a[5], b[2] - z_center * b[5])
    volume = area * max(top - bottom, 0.0)
    return volume / (area_a * a[5] + area_b * b[5] - volume)


def _of_frame(table, frame, cls):
    rows = [
        i
        for i in range(len(table["frame"]))
        if table["frame"][i] == frame and table["cls"][i] == cls
    ]
    boxes = [np.array(table["box"][i], float) for i in rows]
    scores = [float(table["score"][i]) for i in rows] if "score" in table else None
    return boxes, scores, rows


def kradar(truth, found, cls, space, iou, *, classes, variant="revised", cut=0.0):
    """AP of K-Radar's evaluation; variants "revised", "legacy", "yaw"."""
    frames = sorted(
        {f for f, c in zip(truth["frame"], truth["cls"], strict=True) if c in classes}
    )
    scene = []
    num_gt = 0
    for frame in frames:
        gts, _, _ = _of_frame(truth, frame, cls)
        preds, scores, _ = _of_frame(found, frame, cls)
        kept = [i for i in range(len(preds)) if scores[i] > cut]
        preds, scores = [preds[i] for i in kept], [scores[i] for i in kept]
        gts = [np.round(box, 2) for box in gts]
        if variant != "yaw":
            order = [0, 1, 2, 4, 3, 5, 6]
            gts, preds = [b[order] for b in gts], [b[order] for b in preds]
        z_center = 1.0 if variant == "legacy" else 0.5
        values = [
            [float(np.float32(overlap(p, g, space, z_center))) for p in preds]
            for g in gts
        ]
        scene.append((values, scores))
        num_gt += len(gts)
    matched = []
    for values, scores in scene:
        taken = set()
        for row in values:
            best = None
            for j, score in enumerate(scores):
                if j in taken or not row[j] > iou:
                    continue
                if best is None or score > scores[best]:
                    best = j
            if best is not None:
                taken.add(best)
                matched.append(scores[best])
    kept = thresholds(matched, num_gt)
    precision = [0.0] * 41
    for k, threshold in enumerate(kept):
        right = wrong = 0
        for values, scores in scene:
            taken = set()
            for row in values:
                best, best_iou = None, 0.0
                for j, score in enumerate(scores):
                    if j in taken or score < threshold or not row[j] > iou:
                        continue
                    if row[j] > best_iou:
                        best, best_iou = j, row[j]
                if best is not None:
                    taken.add(best)
                    right += 1
            wrong += sum(
                1 for j, s in enumerate(scores) if s >= threshold and j not in taken
            )
        precision[k] = right / (right + wrong)
    for k in range(len(kept)):
        precision[k] = max(precision[k:])
    if variant == "legacy":
        return 100 * sum(precision[::4]) / 11
    return 100 * sum(precision) / 41


def thresholds(matched, num_gt):
    """K-Radar's score thresholds of the scores that are matched."""
    matched = sorted(matched, reverse=True)
    current, kept = 0.0, []
    for i, score in enumerate(matched):
        is_last = i == len(matched) - 1
        left = (i + 1) / num_gt
        right = left if is_last else (i + 2) / num_gt
        if right - current < current - left and not is_last:
            continue
        kept.append(score)
        current += 1 / 40.0
    return kept


def pooled(truth, found, cls, space, iou, *, rule, skip, classes):
    """Sorted (score, is true positive) of all predictions, and the number of objects.

    Args:
        rule: "best" (RADE-Net) or "free" (the recommended protocol).
        skip: None, "class" or "frame".
    """
    entries, num_gt = [], 0
    for frame in sorted({*truth["frame"], *found["frame"]}):
        gts, _, _ = _of_frame(truth, frame, cls)
        preds, scores, rows = _of_frame(found, frame, cls)
        any_gt = any(
            f == frame and c in classes
            for f, c in zip(truth["frame"], truth["cls"], strict=True)
        )
        if (skip == "class" and not gts) or (skip == "frame" and not any_gt):
            continue
        num_gt += len(gts)
        taken = set()
        for j in sorted(range(len(preds)), key=lambda j: (-scores[j], rows[j])):
            values = [overlap(preds[j], gt, space) for gt in gts]
            allowed = [i for i in range(len(gts)) if rule == "best" or i not in taken]
            best = max(allowed, key=lambda i: (values[i], -i), default=None)
            hit = best is not None and values[best] > iou and best not in taken
            if hit:
                taken.add(best)
            entries.append((scores[j], rows[j], hit))
    entries.sort(key=lambda e: (-e[0], e[1]))
    return [(e[0], e[2]) for e in entries], num_gt


def radenet(truth, found, cls, space, iou, *, classes, curve, skip="class"):
    """AP of RADE-Net's evaluator; NaN without objects."""
    entries, num_gt = pooled(
        truth, found, cls, space, iou, rule="best", skip=skip, classes=classes
    )
    if not num_gt:
        return math.nan
    if not entries:
        return 0.0
    points, right, wrong = [(0.0, 1.0)], 0, 0
    for _, hit in entries:
        right, wrong = right + hit, wrong + (not hit)
        points.append((right / (num_gt + 1e-12), right / (right + wrong + 1e-12)))
    if curve == "auc":
        total = 0.0
        for (r0, p0), (r1, p1) in itertools.pairwise(points):
            total += (r1 - r0) * (p0 + p1) / 2
        return 100 * total
    levels = np.linspace(0, 1, {"voc11": 11, "recall41": 41, "coco101": 101}[curve])
    heights = [
        max([p for r, p in points if r >= level], default=0.0) for level in levels
    ]
    return 100 * sum(heights) / len(heights)


def exact(truth, found, cls, space, iou, *, classes, skip=None):
    """AP of the recommended protocol; NaN without objects."""
    entries, num_gt = pooled(
        truth, found, cls, space, iou, rule="free", skip=skip, classes=classes
    )
    if not num_gt:
        return math.nan
    points, right = [], 0
    for k, (score, hit) in enumerate(entries):
        right += hit
        if k + 1 == len(entries) or entries[k + 1][0] != score:
            points.append((right / num_gt, right / (k + 1)))
    total, before = 0.0, 0.0
    for k, (recall, _) in enumerate(points):
        total += (recall - before) * max(p for _, p in points[k:])
        before = recall
    return 100 * total


def average_precision(protocol, truth, found, cls, space, iou, *, classes, cut=0.0):
    """AP by the protocol's name in `radejax.evaluation.protocols`."""
    variants = {
        "kradar_r40": "revised",
        "kradar_r11": "legacy",
        "kradar_r40_corrected": "yaw",
    }
    terms = (truth, found, cls, space, iou)
    if protocol in variants:
        return kradar(*terms, classes=classes, variant=variants[protocol], cut=cut)
    if cut:
        keep = [i for i, s in enumerate(found["score"]) if s > cut]
        found = {k: [v[i] for i in keep] for k, v in found.items()}
    terms = (truth, found, cls, space, iou)
    if protocol == "all_point":
        return exact(*terms, classes=classes)
    return radenet(*terms, classes=classes, curve=protocol)
