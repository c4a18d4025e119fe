import pytest

from placegraph.io.mesh.gltf import read_glb


@pytest.fixture(scope="session")
def house(shared):
    return read_glb(shared / "data/house/map/house.glb")
