"""Commands that another distribution brings, and what is said where it is not installed."""

from importlib import import_module
from importlib.metadata import EntryPoint

import click
import pytest
from click.testing import CliRunner

from placegraph.errors import MissingExtraError

extensions = import_module("placegraph.cli.extensions")  # the package names the function alike
GROUP = "placegraph.commands"


@pytest.fixture
def brought(monkeypatch):
    """Commands of a wing, with the entry points that are installed."""

    def of(wing, *points):
        def installed(*, group):
            assert group == GROUP
            return points

        monkeypatch.setattr("importlib.metadata.entry_points", installed)
        return extensions.extensions(wing)

    return of


@pytest.mark.parametrize(
    ("wing", "name"), [(wing, name) for wing, names in extensions.LAB.items() for name in names]
)
def test_without_the_lab_a_sentence_says_how_to_get_it(brought, wing, name):
    command = brought(wing)[name]
    result = CliRunner().invoke(command, ["a.city", "--out", "b"])
    assert isinstance(result.exception, MissingExtraError)
    assert f"placegraph {wing} {name}" in str(result.exception)
    assert "pip install placegraph-lab" in str(result.exception)
    assert command.help == extensions.LAB[wing][name]


def test_what_is_installed_takes_its_place(brought):
    ours = EntryPoint("city.train", "mine.trainings:train", GROUP)
    other = EntryPoint("scene.train", "mine.trainings:scene", GROUP)
    found = brought("city", ours, other)
    assert found["train"] == "mine.trainings:train"  # imported when it is asked for
    assert isinstance(found["evaluate"], click.Command)
    assert found.keys() == extensions.LAB["city"].keys()


def test_another_command_joins(brought):
    assert brought("scene", EntryPoint("scene.sing", "mine:sing", GROUP))["sing"] == "mine:sing"
