"""PLY: read back it is the same mesh."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from placegraph.errors import MapError, OptionError
from placegraph.io.mesh.ply import read_ply, write_ply

FACES = np.array([(0, 2, 1), (0, 1, 3), (3, 2, 1)])


@given(
    hnp.arrays(np.float32, (4, 3), elements=st.floats(-1e6, 1e6, width=32)),
    hnp.arrays(np.uint8, (4, 3)),
    hnp.arrays(np.int64, 3, elements=st.integers(0, 2**31 - 1)),
)
def test_read_back_it_is_the_same(tmp_path_factory, points, colours, objects):
    path = write_ply(
        tmp_path_factory.mktemp("ply") / "a.ply", points, FACES, colours, objects=objects
    )
    model = read_ply(path)
    assert (model.vertices == points).all()
    assert (model.triangles == FACES).all()
    assert (model.colours == colours).all()
    assert [model.things[row].id for row in model.thing_of] == [str(n) for n in objects]


def test_colours_and_objects_may_be_missing(tmp_path):
    path = write_ply(tmp_path / "a.ply", np.zeros((4, 3)), FACES, comments=("made by a test",))
    model = read_ply(path)
    assert (model.colours == 255).all()
    assert [t.id for t in model.things] == ["0"]
    assert b"\ncomment made by a test\n" in path.read_bytes()
    empty = write_ply(tmp_path / "b.ply", np.zeros((0, 3)), np.zeros((0, 3), int))
    assert len(read_ply(empty).triangles) == 0


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"vertices": np.zeros((4, 2))}, "vertices"),
        ({"triangles": np.zeros((4, 4), int)}, "triangles"),
        ({"colours": np.zeros((3, 3), np.uint8)}, "colours"),
        ({"objects": np.zeros(4, int)}, "objects"),
        ({"comments": ("two\nlines",)}, "comments"),
        ({"comments": ("é",)}, "comments"),
    ],
)
def test_columns_that_do_not_fit(tmp_path, change, name):
    columns = {"vertices": np.zeros((4, 3)), "triangles": FACES}
    with pytest.raises(OptionError, match=name):
        write_ply(tmp_path / "a.ply", **(columns | change))
    assert not list(tmp_path.iterdir())


def test_where_it_cannot_be_written(tmp_path):
    with pytest.raises(MapError, match="cannot be written"):
        write_ply(tmp_path / "no" / "a.ply", np.zeros((4, 3)), FACES)
