"""``quadlift``: serve, check sites, and the commands that other folders add.

Sub-commands of other folders are found by their entry points (group ``quadlift.commands``) and imported only when they
run, so that ``quadlift --help`` needs no extra.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.markup import escape

from service import __version__
from service.errors import QuadliftError
from service.nets.providers import Provider

if TYPE_CHECKING:
    from service.settings import Settings

COMMAND_GROUP = "quadlift.commands"
_EXTRA_BY_PACKAGE = {"clients": "clients", "models_export": "train"}
_HELP = {
    "demo": "Show a live four-camera intersection in the browser.",
    "feed": "Push recordings or live cameras to a running service.",
    "scenes": "Render simulated scenes for training and tests.",
    "train": "Train the networks.",
    "export": "Export trained networks to an ONNX pack.",
    "tune": "Measure which workers and threads do most on this machine.",
    "import-darknet": "Make a pack around YOLOv3 weights in a Darknet file.",
    "import-detector": "Wrap an ONNX detector of your own into a pack.",
    "carla": "Capture scenes from a CARLA server.",
}

app = typer.Typer(
    help="Oriented 3D boxes of vehicles from a few static, calibrated cameras.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
sites_app = typer.Typer(help="Work with site files.", no_args_is_help=True)
app.add_typer(sites_app, name="sites")

_out = Console()
_err = Console(stderr=True)


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="TCP port to listen on.")] = None,
    site: Annotated[list[Path] | None, typer.Option(help="Site file to load; may be given several times.")] = None,
    pack: Annotated[str | None, typer.Option(help="Networks to run: a shipped pack's name or a folder.")] = None,
    provider: Annotated[Provider | None, typer.Option(help="What the networks compute on.")] = None,
    workers: Annotated[int | None, typer.Option(help="Workers that run frame sets side by side.")] = None,
    data_dir: Annotated[Path | None, typer.Option(help="Folder that keeps the sites across restarts.")] = None,
    viewer: Annotated[bool | None, typer.Option(help="Serve the viewer page.")] = None,
) -> None:
    """Run the service. Every setting can also be given as QUADLIFT_<NAME> in the environment; options win."""
    from service.logs import configure_logging
    from service.settings import Settings

    given: dict[str, Any] = {
        "host": host, "port": port, "sites": tuple(site) if site else None, "pack": pack,
        "provider": provider, "workers": workers, "data_dir": data_dir, "viewer": viewer,
    }  # fmt: skip
    try:
        settings = Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        raise _fail(_settings_problem(error)) from None
    configure_logging(settings.log_format, settings.log_level)
    _run(settings)


@sites_app.command("check")
def check_site(file: Annotated[Path, typer.Argument(help="The site file.")]) -> None:
    """Check a site file and show what its cameras see of the ground."""
    from service.site import load_site
    from service.site_report import camera_reports, report_table

    try:
        site = load_site(file)
    except QuadliftError as error:
        raise _fail(str(error)) from None
    reports = camera_reports(site)
    _out.print(report_table(site, reports))
    blind = [report.camera_id for report in reports if report.problem]
    if blind:
        raise _fail(f"cannot work with: {', '.join(blind)}. Check T_cam_world (it maps world to camera) and the ground plane.")
    if not reports:
        raise _fail("the site has no cameras.")


@app.command()
def version() -> None:
    """Print the version."""
    _out.print(__version__, highlight=False)


def add_commands(target: typer.Typer, found: list[EntryPoint]) -> None:
    """List entry points as sub-commands; each hands its arguments over to the app that it loads when it runs."""
    for entry in sorted(found, key=lambda entry: entry.name):
        settings = {"allow_extra_args": True, "ignore_unknown_options": True, "allow_interspersed_args": False}
        help_line = _HELP.get(entry.name, f"From {entry.module}.")
        target.command(entry.name, help=help_line, context_settings=settings, add_help_option=False)(_forwarder(entry))


def main() -> None:
    """Entry point of the ``quadlift`` command."""
    add_commands(app, list(entry_points(group=COMMAND_GROUP)))
    app()


def _forwarder(entry: EntryPoint) -> Any:
    def forward(context: typer.Context) -> None:
        try:
            command = entry.load()
        except ModuleNotFoundError as error:
            raise _fail(_missing(entry, error)) from None
        command(args=context.args, prog_name=f"quadlift {entry.name}")

    return forward


def _missing(entry: EntryPoint, error: ModuleNotFoundError) -> str:
    package = entry.module.partition(".")[0]
    extra = _EXTRA_BY_PACKAGE.get(package)
    if (error.name or "").partition(".")[0] == package or extra is None:
        return f"'quadlift {entry.name}' cannot be loaded: {error}."
    return f"'quadlift {entry.name}' needs {error.name}, which is not installed. Run: pip install 'quadlift[{extra}]'"


def _run(settings: Settings) -> None:
    from service.api.app import create_app, default_pipeline, open_store
    from service.api.server import Server, server_config

    for name in ("tls_cert", "tls_key"):
        path, other = getattr(settings, name), settings.tls_key or settings.tls_cert
        if (path is None) != (other is None) or (path is not None and not path.is_file()):
            raise _fail(f"{name}: {path or 'not given'}. TLS needs a certificate and its key, both as files.")
    try:
        # Both are checked here, before the server starts, so that a bad file ends in one clear line.
        open_store(settings)
        pipeline = default_pipeline(settings)
        app = create_app(settings, lambda _: pipeline)
    except OSError as error:
        raise _fail(f"data_dir: {error}. Give a folder that can be written.") from None
    except QuadliftError as error:
        raise _fail(str(error)) from None
    Server(server_config(settings, app), lambda: app.state.service.drain(), settings.drain_s).run_until_signal()


def _settings_problem(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    name = ".".join(str(part) for part in first["loc"])
    return f"{name}: {first['msg']} (got {first['input']!r}). Set it by option or as QUADLIFT_{name.upper()}."


def _fail(message: str) -> typer.Exit:
    _err.print(f"[bold red]Error:[/] {escape(message)}", highlight=False, soft_wrap=True)
    return typer.Exit(1)
