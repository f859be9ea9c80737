import pytest

from radejax.core.errors import DataError, UserError
from radejax.data.kradar import KRadar, write
from radejax.data.kradar.dataset import held_out

KEYS = [(1, f"{i:05d}_{i:05d}") for i in range(8)] + [(2, "00000_00000")]


def select(tmp_path, **options):
    """Keys of the selected frames, and the data set."""
    for sequence, name in KEYS:
        path = tmp_path / f"labels/{sequence}/{name}.txt"
        write.write_labels(path, [int(name[:5])] * 5, 0.5, [])
    data = KRadar(labels=tmp_path / "labels", **options)
    return [(frame.sequence, frame.name) for frame in data], data


def test_everything_sorted(tmp_path):
    assert select(tmp_path)[0] == KEYS
    assert select(tmp_path, sequence_numbers=[2])[0] == KEYS[8:]


def test_rule_and_file(tmp_path):
    keys, data = select(tmp_path, split="train")
    assert keys == [KEYS[i] for i in (0, 1, 4, 5)]
    assert len(data.summary().notes) == 1
    # A file in `split/` takes precedence over the rule.
    write.write_splits(tmp_path / "split", [KEYS[7], KEYS[3]], [])
    keys, data = select(tmp_path, split="train")
    assert keys == [KEYS[3], KEYS[7]]
    assert not data.summary().notes
    assert select(tmp_path, split="test")[0] == []
    own = tmp_path / "own.txt"
    own.write_text("2,00000_00000.txt\n")
    assert select(tmp_path, split=own)[0] == KEYS[8:]


def test_a_frame_in_both_splits_is_told(tmp_path, caplog):
    write.write_splits(tmp_path / "split", KEYS[:4], KEYS[4:])
    assert not select(tmp_path, split="test")[1].summary().problems
    assert not caplog.text
    write.write_splits(tmp_path / "split", KEYS[:4], KEYS[3:])
    keys, data = select(tmp_path, split="train")
    assert keys == KEYS[:4]
    assert data.summary().problem_counts() == {"split": 1}
    assert "the first of 1 frames that are in both" in caplog.text
    assert "1/00003_00003: the first" in caplog.text
    assert select(tmp_path)[0] == KEYS  # all frames, as `data check` reads them


def test_errors(tmp_path):
    with pytest.raises(UserError, match="'val' is neither"):
        select(tmp_path, split="val")
    with pytest.raises(UserError, match=r"no labels of sequences \[3\] in"):
        select(tmp_path, sequence_numbers=[1, 3])
    (tmp_path / "train.txt").write_text("1 2\n")
    with pytest.raises(
        DataError, match=r"train\.txt:1: '1 2', expected 'sequence,label"
    ):
        select(tmp_path, split="train")
    (tmp_path / "train.txt").write_text("1,00099_00099.txt\n9,00099_00099.txt\n")
    keys, data = select(tmp_path, split="train")
    assert keys == []
    assert data.summary().problem_counts() == {"label file missing": 1}
    assert data.counts["split entries of sequences that are not here"] == 1


def test_whole_sequences_are_held_out_by_number_or_by_a_drawn_share():
    here = range(1, 59)
    assert held_out(here, (), 0) == []
    assert held_out([9, 2, 5], (9, 2), 0) == [2, 9]
    drawn = [held_out(here, (0.1,), seed) for seed in (0, 0, 1)]
    assert [len(numbers) for numbers in drawn] == [6, 6, 6]
    assert drawn[0] == drawn[1] != drawn[2]
    assert held_out(reversed(here), (0.1,), 0) == drawn[0]
    assert len(held_out([3, 4, 5], (0.1,), 0)) == 1  # never none
    with pytest.raises(
        UserError, match=r"holds out sequences \[7\], .*there are \[3, 4"
    ):
        held_out([3, 4], (3, 7), 0)
    for all_of_them in ((3, 4), (0.9,)):
        with pytest.raises(UserError, match="leave at least one"):
            held_out([3, 4], all_of_them, 0)
