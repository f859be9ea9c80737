import pytest

from radejax.core.errors import DataError, UserError
from radejax.data.kradar import write
from radejax.data.kradar.findings import Findings
from radejax.data.kradar.folders import LabelSource
from radejax.data.kradar.splits import held_out, read_split_entries, select_frames

KEYS = [(1, f"{i:05d}_{i:05d}") for i in range(8)] + [(2, "00000_00000")]


def select(tmp_path, strict=False, split=None, sequence_numbers=None):
    findings = Findings(strict=strict)
    source = LabelSource(dict.fromkeys(reversed(KEYS), "x"), None, "here")
    keys = select_frames(
        source,
        findings,
        split=split,
        near=[tmp_path],
        sequence_numbers=sequence_numbers,
    )
    return keys, findings


def test_everything_sorted(tmp_path):
    assert select(tmp_path)[0] == KEYS
    assert select(tmp_path, sequence_numbers=[2])[0] == KEYS[8:]


def test_rule_and_file(tmp_path):
    keys, findings = select(tmp_path, split="train")
    assert keys == [KEYS[i] for i in (0, 1, 4, 5)]
    assert len(findings.notes) == 1
    # A file in `split/` takes precedence over the rule.
    write.write_splits(tmp_path / "split", [KEYS[7], KEYS[3]], [])
    keys, findings = select(tmp_path, split="train")
    assert keys == [KEYS[3], KEYS[7]]
    assert not findings.notes
    assert select(tmp_path, split="test")[0] == []
    own = tmp_path / "own.txt"
    own.write_text("2,00000_00000.txt\n")
    assert select(tmp_path, split=own)[0] == KEYS[8:]


def test_a_frame_in_both_splits_is_told(tmp_path, caplog):
    write.write_splits(tmp_path / "split", KEYS[:4], KEYS[4:])
    assert not select(tmp_path, split="test")[1].problems
    assert not caplog.text
    write.write_splits(tmp_path / "split", KEYS[:4], KEYS[3:])
    keys, findings = select(tmp_path, split="train")
    assert keys == KEYS[:4]
    assert findings.summary().problem_counts() == {"split": 1}
    assert "1 frames are in both" in caplog.text
    assert "first 1/00003_00003: what is evaluated" in caplog.text
    assert select(tmp_path)[0] == KEYS  # all frames, as `data check` reads them


def test_errors(tmp_path):
    with pytest.raises(UserError, match="'val' is neither"):
        select(tmp_path, split="val")
    with pytest.raises(UserError, match=r"no labels of sequences \[3\] in here"):
        select(tmp_path, sequence_numbers=[1, 3])
    (tmp_path / "train.txt").write_text("1 2\n")
    with pytest.raises(
        DataError, match=r"train\.txt:1: '1 2', expected 'sequence,label"
    ):
        read_split_entries("train", [tmp_path], KEYS, Findings(strict=False))
    (tmp_path / "train.txt").write_text("1,00099_00099.txt\n9,00099_00099.txt\n")
    keys, findings = select(tmp_path, split="train")
    assert keys == []
    assert findings.summary().problem_counts() == {"label file missing": 1}
    assert findings.counts["split entries of sequences that are not here"] == 1
    with pytest.raises(FileNotFoundError, match="1/00099_00099: in split train"):
        select(tmp_path, strict=True, split="train")


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
        with pytest.raises(UserError, match="none is left to train on"):
            held_out([3, 4], all_of_them, 0)
