"""Reading KITTI folders: what is read, what is skipped and counted, and errors that name file and line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.accuracy import app
from benchmarks.kitti_folders import read_ids, read_pair
from models_export.data.kitti import KittiObject, write_labels
from service.errors import InputError, NotFoundError

CAR = KittiObject("Car", 0.0, 0, -1.5, (10.0, 20.0, 110.0, 80.0), (1.5, 1.7, 4.2), (-3.0, 1.5, 22.0), 0.7)
RESULT = KittiObject(**{**vars(CAR), "score": 0.875, "truncated": -1.0, "occluded": -1})


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    """Fifty frames of one car each, found exactly."""
    for name in ("labels", "results"):
        (tmp_path / name).mkdir()
    for k in range(50):
        write_labels(tmp_path / "labels" / f"{k:06d}.txt", [CAR])
        write_labels(tmp_path / "results" / f"{k:06d}.txt", [RESULT])
    (tmp_path / "ids.txt").write_text("\n".join(f"{k:06d}" for k in range(50)))
    return tmp_path


def read(folders: Path, ids: list[str] | None = None) -> object:
    return read_pair(folders / "labels", folders / "results", ids or read_ids(folders / "ids.txt"))


def run(folders: Path, *options: str) -> tuple[int, str, str]:
    names = {"--labels": "labels", "--results": "results", "--ids": "ids.txt"}
    arguments = [word for option, name in names.items() for word in (option, str(folders / name))]
    result = CliRunner().invoke(app, ["kitti", *arguments, *options])
    return result.exit_code, result.stdout, result.stderr


def test_arrays_are_in_the_order_of_the_files(folders: Path) -> None:
    write_labels(folders / "labels" / "000001.txt", [CAR, KittiObject(**{**vars(CAR), "type": "Van"})])
    pair = read_pair(folders / "labels", folders / "results", ["000001", "000000"])
    assert pair.truth.type.tolist() == ["car", "van", "car"]
    assert pair.truth.frame.tolist() == [0, 0, 1]
    np.testing.assert_allclose(pair.truth.states[0], [-3.0, 22.0, -1.5 + 0.75, 4.2, 1.7, 1.5, -0.7])
    assert pair.results.score.tolist() == [0.875, 0.875]


def test_the_last_id_needs_no_newline_and_blank_lines_do_not_count(tmp_path: Path) -> None:
    (tmp_path / "ids.txt").write_text("000001\n\n000002")
    assert read_ids(tmp_path / "ids.txt") == ["000001", "000002"]


@pytest.mark.parametrize(
    ("text", "field", "said"), [("1\n2\n1\n", "ids.txt:3", "line 1 already"), ("\n", "ids.txt", "no frame ids")]
)
def test_bad_ids(tmp_path: Path, text: str, field: str, said: str) -> None:
    (tmp_path / "ids.txt").write_text(text)
    with pytest.raises(InputError, match=said) as caught:
        read_ids(tmp_path / "ids.txt")
    assert str(caught.value.field).endswith(field)


def test_missing_ids(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent\.txt"):
        read_ids(tmp_path / "absent.txt")


@pytest.mark.parametrize("name", ["labels", "results"])
def test_a_frame_without_a_file_is_named(folders: Path, name: str) -> None:
    (folders / name / "000007.txt").unlink()
    with pytest.raises(NotFoundError, match=rf"{name}/000007\.txt"):
        read(folders)


def test_a_missing_folder_is_named(folders: Path) -> None:
    with pytest.raises(NotFoundError, match="no such folder"):
        read_pair(folders / "labels", folders / "elsewhere", ["000000"])


def test_a_result_without_a_score_names_file_and_line(folders: Path) -> None:
    write_labels(folders / "results" / "000003.txt", [RESULT])
    with (folders / "results" / "000003.txt").open("a") as file:
        file.write("\n" + " ".join(["Car"] + ["0"] * 14) + "\n")
    with pytest.raises(InputError, match=r"000003\.txt:3: 15 columns, no score"):
        read(folders)


@pytest.mark.parametrize("word", ["nan", "inf", "x"])
def test_a_number_that_is_none_names_file_and_line(folders: Path, word: str) -> None:
    path = folders / "labels" / "000004.txt"
    path.write_text(path.read_text() + path.read_text().replace("22.000000", word))
    with pytest.raises(InputError, match=rf"000004\.txt:2: '{word}'"):
        read(folders)


def test_unknown_types_are_skipped_and_counted(folders: Path) -> None:
    unicorn = KittiObject(**{**vars(CAR), "type": "Unicorn"})
    write_labels(folders / "labels" / "000000.txt", [unicorn, CAR, unicorn])
    pair = read_pair(folders / "labels", folders / "results", ["000000"])
    assert len(pair.truth) == 1
    assert pair.unknown == {"Unicorn": 2}


def test_the_command_prints_the_contracts_json(folders: Path) -> None:
    write_labels(folders / "labels" / "000000.txt", [CAR, KittiObject(**{**vars(CAR), "type": "Unicorn"})])
    code, out, err = run(folders, "--json")
    assert code == 0
    scores = json.loads(out)
    assert set(scores) == {"Car", "Pedestrian", "Cyclist"}
    assert set(scores["Car"]) == {"2d", "bev", "3d", "aos"}
    assert scores["Car"]["3d"] == {"R11": [100.0] * 3, "R40": [100.0] * 3}
    assert "1 objects of the unknown type 'Unicorn' skipped" in err
    assert "Cyclist: 0 / 0 / 0 objects count" in err


def test_the_command_prints_a_table(folders: Path) -> None:
    code, out, err = run(folders)
    assert code == 0
    assert "100.00" in out
    assert "50 frames in" in err


def test_the_overlap_can_be_set(folders: Path) -> None:
    shifted = KittiObject(**{**vars(RESULT), "location": (-3.0, 1.5, 22.4)})
    for k in range(50):
        write_labels(folders / "results" / f"{k:06d}.txt", [shifted])
    figures = [json.loads(run(folders, "--json", *extra)[1])["Car"]["3d"]["R40"] for extra in ([], ["--min-overlap", "0.5"])]
    assert figures == [[0.0] * 3, [100.0] * 3]


def test_a_bad_file_ends_the_command_with_one_line(folders: Path) -> None:
    (folders / "results" / "000002.txt").write_text("Car 1 2\n")
    code, out, err = run(folders, "--json")
    assert code == 2
    assert out == ""
    assert "000002.txt:1" in err.replace("\n", "")
