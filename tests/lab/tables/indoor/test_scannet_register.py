from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geometry import rotation_z
from placegraph.indoor.build import build_scene
from placegraph_lab.tables.indoor.scannet import register_scans
from placegraph_lab.worlds.flat.flat import Flat

LEGEND = """
[legend]
1 room: label=study walls=wallpaper palegoldenrod floor=parquet sienna
S sofa: look=fabric darkred
B shelf: label=bookcase height=2.1
T table: label=desk look=wood burlywood
C cabinet: label=sideboard height=0.8 look=wood peru
"""
HEAD = """
[flat]
name = Room
height = 2.6
[drawing]
"""
BEFORE = """
##########====######
#SSS           BBBB#
#SSS               #
#SSS          1    #
#                  #
#         TTT      #
#         TTT      :
#CCCCCC            #
####################
"""
AFTER = """
##########====######
#              BBBB#
#                  #
#             1    #
#           SSSS   #
#       TTT SSSS   #
#       TTT        :
#CCCCCC            #
####################
"""


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    found = []
    for name, drawing in (("before", BEFORE), ("after", AFTER)):
        interior = Flat.parse(HEAD + drawing.strip() + LEGEND).furnish(np.random.default_rng(1))
        interior.write_glb(folder / f"{name}.glb")
        found.append(build_scene(folder / f"{name}.glb", None))
    return found


@pytest.mark.all
def test_a_room_with_furniture_moved_is_found_again(scans, rng):
    before, after = scans
    map_from_query = np.eye(4)
    map_from_query[:3, :3] = rotation_z(np.pi / 2 + 0.02)  # alignments err by a degree
    map_from_query[:2, 3] = (-7.0, 4.0)
    inverse = np.linalg.inv(map_from_query)
    points = after.mesh.vertices @ inverse[:3, :3].T + inverse[:3, 3]
    points += rng.normal(0.0, 0.005, points.shape)
    query = replace(after, mesh=replace(after.mesh, vertices=points.astype(np.float32)))
    found = register_scans(before, query, rng)
    error = np.linalg.inv(map_from_query) @ found
    assert np.linalg.norm(error[:3, 3]) < 0.03
    assert np.degrees(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))) < 0.5
