import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import InputError, PlacegraphError
from placegraph_lab.worlds.drawing import list_shipped
from placegraph_lab.worlds.flat.flat import OUTSIDE, SOLID, Flat

CHAMBER = """
[flat]
name = Chamber
metres = 0.5 0.25
height = 3

[drawing]
  ####==####
  #SS.1   B#
  #SS     B#
  #  tvt   :
  #  ttt c :
  #     2  #
  ##########

[legend]
1 room: label=study floor=parquet sienna walls=wallpaper palegoldenrod
2 spot:
S sofa: look=fabric darkred
B shelf: label=bookcase height=2.1
t table: label=desk
v drum: in=t label=vase height=0.3
c chair: faces=t
"""


@pytest.fixture(scope="module")
def chamber():
    return Flat.parse(CHAMBER, source="chamber.txt")


def test_rooms_walls_and_the_outside(chamber):
    assert [room.name for room in chamber.rooms] == ["study"]
    assert chamber.rooms[0].symbol.materials["walls"].kind == "wallpaper"
    assert chamber.room_of[0, 0] == OUTSIDE
    assert chamber.room_of[0, 2] == chamber.room_of[0, 7] == chamber.room_of[3, 11] == SOLID
    assert chamber.room_of[1, 3] == 0
    assert len(chamber.rooms[0].cells) == 8 * 5


def test_a_closed_door_blocks_and_divides():
    flat = Flat.parse("[drawing]\n######\n# +  #\n##+###\n#    #\n######\n[legend]\n+ doorway:\n")
    assert len(flat.rooms) == 3
    assert not flat.blocked[1, 2]
    assert Flat.parse("[drawing]\n#####\n# + #\n#####\n[legend]\n").blocked[1, 2]


@pytest.mark.parametrize("name", list_shipped("flats"))
def test_shipped_flats_load(name):
    flat = Flat.load(name)
    rooms, things = (3, 20) if name == "altbau" else (1, 8)
    assert len(flat.rooms) >= rooms
    assert len(flat.objects) >= things


BOX = "[drawing]\n####\n#T #\n####\n[legend]\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no drawing; add a line [drawing]"),
        ("hello", "line 1, column 1: text before the first section"),
        ("[drawing]\n##\t#", "line 2, column 3: a tab"),
        ("[flat]\nwidth = 3\n[drawing]\n#", "line 2, column 1: expected name, metres or height"),
        ("[flat]\nmetres = 0\n[drawing]\n#", "metres = '0' is not the size"),
        ("[flat]\nmetres = 1 2 3\n[drawing]\n#", "metres = '1 2 3' is not the size"),
        ("[flat]\nheight = tall\n[drawing]\n#", "height = 'tall' is not a height"),
        ("[flat]\nheight = nan\n[drawing]\n#", "height = 'nan' is not a height"),
        ("[drawing]\n####\n#  \n####\n", "no room; close the walls"),
        ("[drawing]\n####\n#T #\n####\n", "line 3, column 2: 'T' has no meaning"),
        (BOX + "T throne:", "line 6, column 3: 'throne' is not a kind of object"),
        (BOX + "T:", "line 6, column 1: '' is not a kind of object"),
        (BOX + "table", "line 6, column 1: expected 'glyph kind"),
        (BOX + "T table: wood=oak", "column 9: wood after a table; its keys are base, depth"),
        (BOX + "T table: large", "column 9: no key=value after a table"),
        (BOX + "T spot: label=x", "label after a spot; nothing may follow"),
        (BOX + "T table: height=high", "height='high' is not a length"),
        (BOX + "T table: height=-1", "height='-1' is not a length"),
        (BOX + "T table: height=inf", "height='inf' is not a length"),
        (BOX + "T table: height=0", "height is 0"),
        (BOX + "T table: look=velvet red", "look: 'velvet' is not a material; write one of plain"),
        (BOX + "T table: look=wood mahoganyish", "'mahoganyish' is not a colour; write wood and a"),
        (BOX + "T table: look=wood", "'' is not a colour"),
        (BOX + "T table: faces=up", "faces='up' is not a glyph; write one or one of north"),
        (BOX + "T table: in=RR", "in='RR' is not a glyph; write one."),
        (BOX + "T table: in=", "in='' is not a glyph"),
        (BOX + "T table: in=R", "'T' refers to 'R', which is not another piece of furniture"),
        (BOX + "T table: in=#", "'T' refers to '#'"),
        (BOX + "T table: faces=T", "'T' refers to 'T'"),
        (BOX + "T table:\n# table:", "# is always a wall"),
        (BOX + "T table: in=R\nR rug: in=T", "'T' stands in 'R', which stands in it"),
        (BOX + "T drum: in=R\nR rug:", "line 3, column 2: 'T' stands in 'R', but touches none"),
        (
            "[drawing]\n####\n#1 #\n# 1#\n####\n[legend]\n1 room:",
            "line 4, column 3: the room has two labels",
        ),
        ("[drawing]\n####\n#  #T\n####\n[legend]\nT table:", "column 5: 'T' stands in no room"),
    ],
)
def test_errors_say_where_and_how_to_mend(text, said):
    with pytest.raises(InputError) as error:
        Flat.parse(text, source="x.txt")
    assert said in str(error.value)
    assert "x.txt" in str(error.value)


@pytest.mark.parametrize(
    ("row", "kind", "said"),
    [
        ("#  =  #", "", "this window leads through no wall"),
        ("#  #  #", "T picture:", ""),
        ("#  T  #", "T picture:", "this picture hangs on no wall; draw it beside one (#)"),
        ("#  T  #", "T table: height=2.7", "ends 2.7 m above the floor of a room 2.6 m high"),
        ("#  T  :", "T drum:\n: doorway: height=2.6", "ends 2.6 m above the floor of a room"),
        (":  #  :", "", ""),
    ],
)
def test_errors_of_furnishing(row, kind, said, rng):
    page = ["#######", "#     #", row, "#     #", "#######"]
    flat = Flat.parse("[drawing]\n" + "\n".join(page) + "\n[legend]\n" + kind, source="x.txt")
    if not said:
        assert flat.furnish(rng).objects
        return
    with pytest.raises(InputError) as error:
        flat.furnish(rng)
    assert said in str(error.value)
    assert "x.txt, line 4, column" in str(error.value)


@given(st.text())
def test_any_text_is_a_flat_or_an_error(text):
    try:
        Flat.parse(text)
    except PlacegraphError:
        return
