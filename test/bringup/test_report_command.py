"""`tactile report`: from a bag to numbers and pictures."""

from pathlib import Path

from tactile_bringup.cli import main


def test_a_folder_that_is_no_bag_is_refused_in_a_sentence(tmp_path: Path, capsys):
    assert main(["report", str(tmp_path / "nothing")]) == 2
    assert "tactile report:" in capsys.readouterr().err
