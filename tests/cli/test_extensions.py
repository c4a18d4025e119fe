"""Commands that another distribution brings, and what is said where it is not installed."""

from importlib.metadata import EntryPoint
from types import SimpleNamespace

import pytest
import typer
from typer.testing import CliRunner

from placegraph.cli import extensions
from placegraph.errors import MissingExtraError


def brought(name: str) -> None:
    """Say hello."""
    typer.echo(f"hello {name}")


@pytest.fixture
def app_of(monkeypatch):
    """App of a wing, with the entry points that are installed."""

    def make(wing, *points):
        def installed(*, group):
            assert group == "placegraph.commands"
            return points

        monkeypatch.setattr(extensions, "entry_points", installed)
        app = typer.Typer()
        app.callback()(lambda: None)
        extensions.add_extensions(app, wing)
        return app

    return make


@pytest.mark.parametrize(
    ("wing", "name"), [(wing, name) for wing, names in extensions.LAB.items() for name in names]
)
def test_without_the_lab_a_sentence_says_how_to_get_it(app_of, wing, name):
    result = CliRunner().invoke(app_of(wing), [name, "a.city", "--out", "b"])
    assert isinstance(result.exception, MissingExtraError)
    assert f"placegraph {wing} {name}" in str(result.exception)
    assert "pip install placegraph-lab" in str(result.exception)


def test_without_the_lab_its_commands_are_listed(app_of):
    shown = CliRunner().invoke(app_of("city"), ["--help"]).output
    assert all(name in shown for name in extensions.LAB["city"])


def test_what_is_installed_takes_its_place(app_of):
    ours = SimpleNamespace(name="city.train", load=lambda: brought)
    other = EntryPoint("scene.train", "nowhere:at_all", "placegraph.commands")
    app = app_of("city", ours, other)
    assert CliRunner().invoke(app, ["train", "you"]).output == "hello you\n"
    assert isinstance(CliRunner().invoke(app, ["evaluate"]).exception, MissingExtraError)
