"""Commands of other distributions, and the sentence where one is not installed."""

from importlib import import_module
from importlib.metadata import EntryPoint

import click
import pytest
from click.testing import CliRunner

from placegraph.errors import MissingExtraError

extensions = import_module("placegraph.cli.command")  # the package names the function alike
GROUP = "placegraph.commands"


@pytest.fixture
def brought(monkeypatch):
    """Commands of a wing, with the entry points that are installed."""

    def of(wing, *points):
        monkeypatch.setattr(
            extensions, "plugins", lambda group: {p.name: p for p in points if group == GROUP}
        )
        return extensions.extensions(wing)

    return of


@pytest.mark.parametrize("name", extensions.KNOWN)
def test_a_missing_distribution_is_named(brought, name):
    wing, _, word = name.rpartition(".")
    command = brought(wing)[word]
    result = CliRunner().invoke(command, ["a.city", "--out", "b"])
    assert isinstance(result.exception, MissingExtraError)
    assert f"`placegraph {name.replace('.', ' ')}`" in str(result.exception)
    assert "pip install" in str(result.exception)
    assert command.help == extensions.KNOWN[name][1]


def test_what_is_installed_takes_its_place_or_joins(brought):
    ours = EntryPoint("city.train", "mine.trainings:train", GROUP)
    other = EntryPoint("scene.train", "mine.trainings:scene", GROUP)
    found = brought("city", ours, other)
    assert found["train"] == "mine.trainings:train"  # imported when it is asked for
    assert isinstance(found["evaluate"], click.Command)
    assert found.keys() == {n[5:] for n in extensions.KNOWN if n.startswith("city.")}
    assert brought("scene", EntryPoint("scene.sing", "mine:sing", GROUP))["sing"] == "mine:sing"
