import collections

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.data.dataset import held_out
from radejax.data.kradar import KRadar, write
from radejax.data.kradar.folders import read_split, split_by_rule

KEYS = [(1, f"{i:05d}_{i:05d}") for i in range(8)] + [(2, "00000_00000")]


def select(tmp_path, **options):
    """Keys of the selected frames, and the dataset."""
    for sequence, name in KEYS:
        path = tmp_path / f"labels/{sequence}/{name}.txt"
        write.write_labels(path, [int(name[:5])] * 5, 0.5, [])
    data = KRadar(labels=tmp_path / "labels", **options)
    return [(frame.sequence, frame.name) for frame in data], data


def test_rule_and_file(tmp_path):
    keys, data = select(tmp_path, split="train")
    assert keys == [KEYS[i] for i in (0, 1, 4, 5)]
    assert select(tmp_path)[0] == KEYS
    assert select(tmp_path, sequences=[2])[0] == KEYS[8:]
    assert "K-Radar's rule" in data.summary().to_text()
    # A file in `split/` takes precedence over the rule.
    write.write_splits(tmp_path / "split", [KEYS[7], KEYS[3]], [])
    keys, data = select(tmp_path, split="train")
    assert keys == [KEYS[3], KEYS[7]]
    assert not data.summary().notes
    assert select(tmp_path, split="test")[0] == []
    own = tmp_path / "own.txt"
    own.write_text("2,00000_00000.txt\n")
    assert select(tmp_path, split=own)[0] == KEYS[8:]


def test_rule_gives_alternating_quarters():
    names = [f"{i:05d}_00000" for i in range(10)]  # cuts at 2, 5, 7
    assert split_by_rule(names, "train") == names[:2] + names[5:7]
    assert split_by_rule(reversed(names), "test") == names[2:5] + names[7:]


def test_rule_equals_the_official_split(shared):
    folder = shared / "data/kradar/split"
    splits = {s: read_split(folder / f"{s}.txt") for s in ("train", "test")}
    names = collections.defaultdict(list)
    for sequence, name in splits["train"] + splits["test"]:
        names[sequence].append(name)
    for split, frames in splits.items():
        ruled = [(s, n) for s in sorted(names) for n in split_by_rule(names[s], split)]
        assert ruled == sorted(frames)


def test_splits_of_an_opened_data_set_read_no_label_again(
    tmp_path, kradar_writer, monkeypatch
):
    kradar_writer(tmp_path)
    path = tmp_path / "1/info_label/00004_00001.txt"
    path.write_text(path.read_text() + "*, R, 1, Tree, 1, 2, 3, 4, 5, 6, 7\n")
    (tmp_path / "mine.txt").write_text("1,00004_00001.txt\n2,00009_00006.txt\n")
    (tmp_path / "none.txt").write_text("7,00004_00001.txt\n")

    splits = (None, "train", "test", tmp_path / "mine.txt", tmp_path / "none.txt")
    wanted = [KRadar(tmp_path, split=split) for split in splits]
    for first in (None, "test"):
        data = KRadar(tmp_path, split=first)
        before = data.summary()
        for split, other in zip(splits, wanted, strict=True):
            found = data.of_split(split)
            assert found.summary() == other.summary()
            assert [frame.key for frame in found] == [frame.key for frame in other]
            for a, b in zip(found, other, strict=True):
                np.testing.assert_array_equal(a.boxes, b.boxes)
        assert data.summary() == before


def test_whole_sequences_are_held_out_by_number_or_by_a_drawn_share():
    here = range(1, 59)
    assert held_out(here, (), 0) == []
    assert held_out([9, 2, 5], (9, 2), 0) == [2, 9]
    drawn = [held_out(here, (0.1,), seed) for seed in (0, 0, 1)]
    assert [len(numbers) for numbers in drawn] == [6, 6, 6]
    assert drawn[0] == drawn[1] != drawn[2]
    assert held_out(reversed(here), (0.1,), 0) == drawn[0]
    assert len(held_out([3, 4, 5], (0.1,), 0)) == 1  # never none
    with pytest.raises(UserError, match=r"holds out sequences \[7\], .*there are \[3,"):
        held_out([3, 4], (3, 7), 0)
    for all_of_them in ((3, 4), (0.9,)):
        with pytest.raises(UserError, match="leave at least one"):
            held_out([3, 4], all_of_them, 0)
