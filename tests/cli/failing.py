"""How every command fails."""


def fails(result, code, *words):
    """Check that a run failed with one sentence on stderr, and nothing on stdout."""
    assert (result.code, result.out) == (code, ""), result.err
    (line,) = result.err.strip().splitlines()
    assert line.startswith("placegraph: ")
    assert line.rstrip('"').endswith((".", "?")), line
    for word in words:
        assert str(word) in line
