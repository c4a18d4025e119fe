"""How every command fails."""


def fails(result, code, *words, lines=1):
    """Check that a run failed with one sentence on stderr, or a few lines, and nothing on stdout."""
    assert (result.code, result.out) == (code, ""), result.err
    line = result.err.strip()
    assert len(line.splitlines()) == lines, line
    assert line.startswith("placegraph: ")
    assert line.rstrip('"').endswith((".", "?")), line
    for word in words:
        assert str(word) in line
