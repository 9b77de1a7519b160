"""Run the `smartview` command as `python -m smartview_jax`."""

from .cli import app

app(prog_name="smartview")
