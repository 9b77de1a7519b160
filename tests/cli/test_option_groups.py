from dataclasses import dataclass, field
from typing import Annotated

import typer
from typer.testing import CliRunner

from smartview_jax.cli.options import with_option_groups


@dataclass(frozen=True)
class Pen:
    colour: Annotated[str, typer.Option(help="Of the ink.")] = "black"
    width: Annotated[float, typer.Option("--broad", help="In millimetres.")] = 0.5


@dataclass(frozen=True)
class Desk:
    lamp: Annotated[bool, typer.Option("--lamp")] = False
    pen: Pen = field(default_factory=Pen)
    height: Annotated[float, typer.Option(help="In metres.")] = 0.7


def test_a_group_may_hold_a_group():
    received = []

    @with_option_groups
    def sit(desk: Desk) -> None:
        received.append(desk)

    app = typer.Typer()
    app.command()(sit)
    assert CliRunner().invoke(app, ["--colour", "red", "--height", "1"]).exit_code == 0
    assert received == [Desk(pen=Pen("red"), height=1.0)]


def test_a_group_is_options_outside_and_one_object_inside():
    received = {}

    @with_option_groups
    def draw(paper: str, *, pen: Pen, twice: bool = False) -> None:
        received.update(paper=paper, pen=pen, twice=twice)

    app = typer.Typer()
    app.command()(draw)
    assert CliRunner().invoke(app, ["a4", "--broad", "2", "--twice"]).exit_code == 0
    assert received == {"paper": "a4", "pen": Pen("black", 2.0), "twice": True}
    # The options stand where the group stood.
    shown = CliRunner().invoke(app, ["--help"]).output
    assert shown.index("--colour") < shown.index("--broad") < shown.index("--twice")
