import sys

import pytest

from placegraph.errors import InputError
from placegraph_lab.cli import lab


def test_names_steer_no_terminal(monkeypatch, capsys):
    before = sys.stdout, sys.stderr

    def fails():
        sys.stdout.write("\x1b[2J\n")
        raise InputError("\x1b]0;owned\x07 is no map; build one.")

    monkeypatch.setattr(lab, "app", fails)
    with pytest.raises(SystemExit) as end:
        lab.main()
    assert end.value.code == InputError.exit_code
    written = capsys.readouterr()
    assert written.out == "\\u001b[2J\n"
    assert "\\u001b]0;owned\\u0007 is no map" in written.err
    assert (sys.stdout, sys.stderr) == before
