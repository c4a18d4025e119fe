import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import OptionError
from placegraph.indoor.rays import RayCaster
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.walls import SEAM


def furnished(drawing, legend="", head="", seed=0):
    text = f"[flat]\n{head}\n[drawing]\n{drawing}\n[legend]\n{legend}"
    flat = Flat.parse(text)
    return flat, flat.furnish(np.random.default_rng(seed))


def caster(interior):
    mesh = interior.mesh()
    return mesh, RayCaster(mesh.vertices, mesh.triangles)


@pytest.fixture(scope="module")
def altbau():
    flat = Flat.load("altbau")
    return flat, flat.furnish(np.random.default_rng(1))


BARE = "####\n#  #\n#  #\n####"


def test_a_bare_room_is_floor_ceiling_and_four_walls():
    _, interior = furnished(BARE, head="metres = 1\nheight = 3")
    names = ["floor", "ceiling", "wall 1", "wall 2", "wall 3", "wall 4"]
    assert [thing.name for thing in interior.objects] == names
    assert [thing.id for thing in interior.objects] == list(range(6))
    bounds = {thing.name: thing.bounds.tolist() for thing in interior.objects}
    for which, z in (("floor", 0.0), ("ceiling", 3.0)):
        expected = [[1 - SEAM, 1 - SEAM, z], [3 + SEAM, 3 + SEAM, z]]
        assert np.allclose(bounds[which], expected)
    assert sorted(bounds[f"wall {k}"] for k in (1, 2, 3, 4)) == [
        [[1, 1, 0], [1, 3, 3]], [[1, 1, 0], [3, 1, 3]],
        [[1, 3, 0], [3, 3, 3]], [[3, 1, 0], [3, 3, 3]],
    ]  # fmt: skip


def test_things_stay_in_their_rooms(altbau):
    flat, interior = altbau
    for thing in interior.objects[len(interior.objects) - len(flat.objects) :]:
        low, high = thing.bounds
        assert low[2] >= 0.0
        assert high[2] <= flat.height + 1e-9
        for x, y in ((low[0], low[1]), (high[0], high[1]), (low[0], high[1]), (high[0], low[1])):
            assert flat.room_of[flat.cell(x, y)] >= 0, thing.name


def test_moved_and_taken_away(altbau):
    _, interior = altbau
    sofa, chair = interior.find_object("sofa"), interior.find_object("chair 1")
    moved = interior.move_object("sofa", (0.5, -0.25), np.pi / 2)
    extent = np.diff(sofa.bounds, axis=0)[0]
    turned = np.diff(moved.find_object("sofa").bounds, axis=0)[0]
    assert turned == pytest.approx(extent[[1, 0, 2]])
    shift = moved.find_object("sofa").bounds.mean(axis=0) - sofa.bounds.mean(axis=0)
    assert shift == pytest.approx([0.5, -0.25, 0.0])
    assert moved.find_object("chair 1") is chair
    gone = moved.without("sofa")
    assert len(gone.objects) == len(interior.objects) - 1
    assert gone.find_object("chair 1").id == chair.id  # ids stay
    assert sofa.id not in gone.mesh().object_of
    with pytest.raises(OptionError):
        gone.without("sofa")


def inside(flat, n, rng):
    room = np.argwhere(flat.room_of >= 0)
    cells = room[rng.integers(len(room), size=n)]
    at = (cells[:, ::-1] + rng.random((n, 2))) * flat.metres
    at[:, 1] = flat.size[1] - at[:, 1]
    return np.column_stack([at, rng.uniform(0.0, flat.height, n)])


def test_rays_leave_through_an_open_door_only(rng):
    flat, interior = furnished("#####\n#   #\n#   :\n#   #\n#####", head="metres = 1")
    _, cast = caster(interior)
    origins = inside(flat, 20_000, rng)
    directions = rng.standard_normal(origins.shape)
    out = cast.cast(origins, directions).triangle < 0
    share = (5.0 - origins[:, 0]) / directions[:, 0]  # to the outer face of the wall
    at = origins + share[:, None] * directions
    door = (share > 0) & (np.abs(at[:, 1] - 2.5) < 0.5) & (at[:, 2] > 0) & (at[:, 2] < 2.05)
    assert 20 < out.sum() < 2000
    assert door[out].all()


@given(
    st.lists(st.text("# ", min_size=6, max_size=6), min_size=1, max_size=6),
    st.integers(0, 2**32 - 1),
)
def test_any_plan_is_watertight_and_as_drawn(rows, seed):
    drawing = ["########", *(f"#{row}#" for row in rows), "########"]
    if not any(" " in row for row in rows):
        return
    flat, interior = furnished("\n".join(drawing), head="metres = 0.5\nheight = 2")
    mesh, cast = caster(interior)
    cells = np.argwhere(flat.room_of >= 0)
    origins = np.array([(*flat.corner(r + 0.5, c + 0.5), 1.1) for r, c in cells])
    for (dr, dc), direction in {
        (0, 1): (1, 0, 0), (0, -1): (-1, 0, 0), (1, 0): (0, -1, 0), (-1, 0): (0, 1, 0)
    }.items():  # fmt: skip
        free = np.array([_run(drawing, r, c, dr, dc) for r, c in cells])
        hits = cast.cast(origins, np.tile(np.array(direction, float), (len(cells), 1)))
        assert hits.distance == pytest.approx(0.5 * free + 0.25, abs=1e-5)
        labels = {interior.objects[i].label for i in mesh.object_of[hits.triangle]}
        assert labels == {"wall"}
    rng = np.random.default_rng(seed)
    many = np.repeat(origins, 50, axis=0)
    assert (cast.cast(many, rng.standard_normal(many.shape)).triangle >= 0).all()


def _run(drawing, row, column, dr, dc):
    n = 0
    while drawing[row + (n + 1) * dr][column + (n + 1) * dc] == " ":
        n += 1
    return n
