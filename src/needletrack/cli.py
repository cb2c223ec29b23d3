"""The command line: each command turns arguments into one call of the package, and its answer into text.

Exit codes: 0; 1 where something failed that was not the caller's to prevent; 2 where something given cannot
be used, with one line on stderr that says what and the remedy; 130 after Ctrl-C.
"""

import os
import re
from collections.abc import Callable
from datetime import UTC, datetime
from functools import wraps
from math import acos, degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, ParamSpec

import typer

from needletrack import __version__
from needletrack.errors import CalibrationError, NeedletrackError, RecordingError
from needletrack.publish.keys import DEFAULT_ENDPOINT, DEFAULT_PREFIX

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console

    from needletrack.calibration.board import Board
    from needletrack.calibration.bundle import Terms
    from needletrack.config import Config
    from needletrack.records import DropReason
    from needletrack.rig import Rig

# What loads NumPy, SciPy and OpenCV is imported by the commands themselves: they read these variables when
# they are loaded. For matrices as small as ours, two threads took twice the time of one.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_variable, "1")

LAB_RECORDING = Path("tests/data/recordings/lab-a")
_TABLE_WIDTH = 160
# Of a film; one pair would do.
_CHECK_MOST = 12
_TERMS: "dict[str, Terms]" = {"4": 4, "5": 5, "8": 8}

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    help="Track a needle in 3D from two cameras, and publish its shape over Zenoh.",
)
rig_app = typer.Typer(no_args_is_help=True, help="Rig files: both cameras and the pose between them.")
config_app = typer.Typer(no_args_is_help=True, help="The configuration file.")
app.add_typer(rig_app, name="rig")
app.add_typer(config_app, name="config")
security_app = typer.Typer(no_args_is_help=True, help="Who may read, publish and command: certificates and rules.")
app.add_typer(security_app, name="security")

P = ParamSpec("P")

Recording = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="Folder in the EuRoC/ASL layout, file of `record`, or ROS bag.")
]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="TOML file (docs/configuration.md).")]
RigFile = Annotated[
    Path | None,
    typer.Option(
        "--rig",
        help="Rig file or Kalibr camchain. Without it: rig.path of the configuration; without that: "
        "the recording's own rig.yaml or camchain.yaml.",
    ),
]
Independent = Annotated[
    bool, typer.Option("--independent", help="Start every pair without memory: for recordings of stills.")
]
Connect = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ENDPOINT",
        help=f"Where the daemon or its router is; else subscribing.connect, by default {DEFAULT_ENDPOINT}.",
    ),
]
KeyPrefix = Annotated[str | None, typer.Option(help="As in the daemon's; else subscribing.key_prefix.")]
AsClient = Annotated[bool, typer.Option("--client", help="Be a client, of a router; else as subscribing.mode.")]
Start = Annotated[int, typer.Option(min=0, help="First pair, from 0.")]
End = Annotated[int | None, typer.Option(min=0, help="The pair after the last; all without it.")]
Method = Annotated[Literal["curve", "reference"], typer.Option(help="Ours, or that of 2017.")]
RigPath = Annotated[Path, typer.Argument(metavar="PATH", help="Rig file, Kalibr camchain, or a folder with either.")]


def plain_errors(command: Callable[P, None]) -> Callable[P, None]:
    """The same command, which tells an error that we raise on purpose in one line, and exits with 2."""

    @wraps(command)
    def told(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except NeedletrackError as error:
            _complain(error)
            raise typer.Exit(2) from error

    return told


@app.command()
@plain_errors
def demo(
    recording: Recording,
    output: Annotated[Path, typer.Option(help="Folder for pictures and tracks.")] = Path("build/demo"),
    seconds: Annotated[float, typer.Option(min=0.1, help="About how long to play.")] = 11.0,
) -> None:
    """Track a recording at its own pace, and watch the tracks arrive in another process.

    Played forward and backward in turn, through the live loop and over Zenoh on this machine alone.
    """
    from rich.console import Console

    from needletrack.demo import SubscriberFailed, run_demo
    from needletrack.terminal import Interruption, warnings_shown

    typer.echo(f"needletrack demo: {recording}, about {seconds:g} s, tracks received by another process")
    with Interruption() as interruption, warnings_shown(Console(stderr=True), at_end=True):
        try:
            report = run_demo(recording, output, seconds=seconds, stop=interruption.stop)
        except SubscriberFailed as error:
            if not interruption.exit_code:  # Ctrl-C reaches the subscriber too
                _complain(error)
            raise typer.Exit(interruption.exit_code or 1) from error
    typer.echo(report)
    raise typer.Exit(interruption.exit_code)


@app.command()
@plain_errors
def replay(
    recording: Recording,
    rig: RigFile = None,
    config: ConfigFile = None,
    paced: Annotated[
        bool,
        typer.Option(
            "--paced/--every-frame",
            help="At the recorded pace, as live: what comes too fast is dropped and counted. Or every pair, "
            "as fast as it goes: the same output bytes every time.",
        ),
    ] = False,
    independent: Independent = False,
    as_published: Annotated[
        bool,
        typer.Option(
            "--as-published",
            help="The pairs that were tracked live, each from what it was tracked from live: the tracks that were "
            "published while this was recorded, byte for byte but for times.",
        ),
    ] = False,
    start: Start = 0,
    end: End = None,
    loop: Annotated[int, typer.Option(min=1, help="Play so many times, forward and backward in turn.")] = 1,
    method: Method = "curve",
    output: Annotated[
        Path | None, typer.Option(help="Write the tracks: .jsonl (all) or .csv (no centerlines).")
    ] = None,
    publish: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help=f"Publish on Zenoh, e.g. {DEFAULT_ENDPOINT}.")
    ] = None,
) -> None:
    """Track a recording through the same service that runs live.

    Every readable pair gives a track, unless --paced drops it; the summary, on stderr, counts what was lost
    by reason. Exit code 0; 1 where no pair could be tracked; 2 where something given cannot be used; 130
    after Ctrl-C, which ends it with what was done so far.
    """
    from rich.console import Console

    from needletrack.config import load_config
    from needletrack.replay import Replay, open_recording
    from needletrack.terminal import Interruption, ProgressBar, described, warnings_shown

    effective, console = load_config(config), Console(stderr=True)
    with Interruption() as interruption, warnings_shown(console):
        played = Replay(
            open_recording(recording, effective, rig),
            effective,
            method=method,
            paced=paced,
            independent=independent,
            as_published=as_published,
            start=start,
            end=end,
            loop=loop,
        )
        with ProgressBar(console, start, len(played.source)) as progress:
            summary = played.run(interruption.stop, output=output, publish=publish, sinks=[progress])
    typer.echo(described(summary), err=True)
    raise typer.Exit(interruption.exit_code or (0 if summary.pairs else 1))


@app.command()
@plain_errors
def report(
    recording: Recording,
    output: Annotated[Path, typer.Option(help="The HTML file to write.")] = Path("report.html"),
    rig: RigFile = None,
    config: ConfigFile = None,
    independent: Independent = False,
    start: Start = 0,
    end: End = None,
    method: Method = "curve",
    most: Annotated[
        int, typer.Option(min=0, help="Show so many pairs in full, the worst; the figures are of all.")
    ] = 40,
    truth: Annotated[
        bool, typer.Option("--truth/--no-truth", help="Compare with the recording's truth.json, where it has one.")
    ] = True,
) -> None:
    """Track a recording, and write one HTML page to look at: figures over the pairs, and the worst pairs in full.

    The page holds all that it shows, about 250 kB for a pair shown in full. Exit codes as of replay.
    """
    from rich.console import Console

    from needletrack.config import load_config
    from needletrack.replay import Replay, open_recording
    from needletrack.report import write_report
    from needletrack.terminal import Interruption, ProgressBar, described, warnings_shown

    effective, console = load_config(config), Console(stderr=True)
    with Interruption() as interruption, warnings_shown(console):
        opened = open_recording(recording, effective, rig)
        played = Replay(opened, effective, method=method, independent=independent, start=start, end=end)
        with ProgressBar(console, start, len(played.source)) as progress:
            written = write_report(played, output, interruption.stop, most=most, with_truth=truth, sinks=[progress])
    typer.echo(described(written.run), err=True)
    size_mb = written.size_bytes / 1e6
    typer.echo(f"written: {written.path}, {size_mb:.1f} MB, {written.shown} of {written.run.pairs} pairs in full")
    raise typer.Exit(interruption.exit_code or (0 if written.run.pairs else 1))


RunRig = Annotated[
    Path | None, typer.Option("--rig", help="Rig file, camchain, or folder; else rig.path of the configuration.")
]


@app.command()
def run(rig: RunRig = None, config: ConfigFile = None) -> None:
    """Track both cameras and publish, until SIGTERM or Ctrl-C: the daemon.

    Exit codes: 0 it was asked to stop; 1 a defect; 2 configuration, rig, endpoint or folder cannot be used; 3 a camera
    does not do what is configured, or may not be opened; 4 a daemon of the rig runs already.
    """
    from needletrack.daemon.process import load_without_collecting

    load_without_collecting()
    from needletrack.config import load_config
    from needletrack.daemon.logs import logged
    from needletrack.daemon.run import Daemon, exit_code
    from needletrack.publish.session import is_still_closing
    from needletrack.terminal import Interruption, described_skew
    from needletrack.terminal import described as described_run

    try:
        effective = load_config(config)
        daemon = Daemon(_rig_for(rig, effective), effective)
        context = {"rig": daemon.rig.name, "run_id": daemon.context.run_id}
        with logged(context), Interruption() as interruption:
            summary = daemon.run(interruption.stop)
    except NeedletrackError as error:
        _complain(error)
        raise typer.Exit(exit_code(error)) from error
    typer.echo(described_run(summary.run), err=True)
    typer.echo(described_skew(summary.skew), err=True)
    if summary.recorded is not None:
        typer.echo(f"  recorded: {summary.recorded} pairs, not recorded: {summary.unrecorded}", err=True)
    if is_still_closing():
        # All is done and told; Zenoh would keep the process for up to 10 s, for a subscriber that hangs.
        os._exit(0)


@app.command()
@plain_errors
def record(
    output: Annotated[Path, typer.Argument(metavar="FILE", help="The recording to write, e.g. board.mcap.")],
    rig: RunRig = None,
    config: ConfigFile = None,
    seconds: Annotated[float | None, typer.Option(min=0, help="For so long; else until Ctrl-C.")] = None,
    pairs: Annotated[int | None, typer.Option(min=1, help="So many pairs.")] = None,
) -> None:
    """Record both cameras, without tracking; a rig is put into the file, and not needed for it."""
    from rich.console import Console

    from needletrack.config import load_config
    from needletrack.daemon.record import record as recorded
    from needletrack.terminal import Interruption, described_skew, warnings_shown

    effective = load_config(config)
    known = _rig_for(rig, effective) if rig is not None or effective.rig.path is not None else None
    with Interruption() as interruption, warnings_shown(Console(stderr=True)):
        done = recorded(effective, output, interruption.stop, rig=known, seconds=seconds, pairs=pairs)
    typer.echo(
        f"{output}: {done.pairs} pairs in {done.duration_s:.1f} s, {done.megabytes:.1f} MB; "
        f"{done.unrecorded} not recorded; frames lost: {_counts(done.dropped)}",
        err=True,
    )
    typer.echo(described_skew(done.skew), err=True)
    raise typer.Exit(interruption.exit_code or (0 if done.pairs else 1))


@app.command()
@plain_errors
def recover(
    damaged: Annotated[Path, typer.Argument(metavar="FILE", help="A recording that was cut off.")],
    output: Annotated[Path, typer.Argument(metavar="OUTPUT", help="The file to write.")],
) -> None:
    """Save what is whole of a recording that was cut off, by a power cut or a SIGKILL."""
    from needletrack.recording.mcap_file import recover as recovered

    saved = recovered(damaged, output)
    typer.echo(
        f"{output}: {saved.pairs} pairs, {saved.tracks} tracks; {saved.lost_bytes} bytes at the end were not whole"
    )


@app.command()
@plain_errors
def export(
    recording: Recording,
    output: Annotated[Path, typer.Argument(metavar="FOLDER", help="The folder to write.")],
    to: Annotated[Literal["asl", "ros2"], typer.Option(help="EuRoC/ASL folders with PNG, or a ROS 2 bag.")] = "asl",
    rig: RigFile = None,
) -> None:
    """Write any recording as folders of images, or as a ROS 2 bag."""
    from needletrack.recording.stored import export as exported
    from needletrack.replay import rig_at

    written = exported(recording, output, to, None if rig is None else rig_at(rig))
    for sentence in written.left_out:
        typer.echo(f"left out: {sentence}", err=True)
    typer.echo(f"{written.path}: {written.pairs} pairs")


@app.command("import")
@plain_errors
def import_recording(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="ROS bag (1 or 2), or an ASL folder.")],
    output: Annotated[Path, typer.Argument(metavar="FILE", help="The recording to write, e.g. lab.mcap.")],
    rig: Annotated[Path, typer.Option(help="The rig that it was taken with, which goes into the file.")],
    left: Annotated[str | None, typer.Option(help="Topic of the left images, where the names do not tell.")] = None,
    right: Annotated[str | None, typer.Option(help="Topic of the right images.")] = None,
    tolerance_us: Annotated[float, typer.Option(min=0, help="As pairing.tolerance_us.")] = 1000.0,
) -> None:
    """Make a recording of a ROS bag with two topics of images."""
    from needletrack.recording.stored import import_recording as imported
    from needletrack.replay import rig_at

    if (left is None) != (right is None):
        raise RecordingError("--left and --right go together")
    topics = None if left is None or right is None else (left, right)
    written = imported(recording, output, rig_at(rig), topics=topics, tolerance_us=tolerance_us)
    for sentence in written.left_out:
        typer.echo(f"left out: {sentence}", err=True)
    typer.echo(f"{written.path}: {written.pairs} pairs")


@app.command()
@plain_errors
def doctor(
    rig: RunRig = None,
    config: ConfigFile = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="Let the cameras stream for so long.")] = 2.0,
) -> None:
    """Look at cameras, rights, disk, clock, rig and endpoints; each line passes, warns or fails, with the remedy.

    Exit code 1 where something fails.
    """
    from needletrack.config import load_config
    from needletrack.doctor import Verdict, examine

    effective = load_config(config)
    failed = False
    for finding in examine(effective, lambda: _rig_for(rig, effective), seconds=seconds):
        typer.echo(finding)
        failed |= finding.verdict is Verdict.FAIL
    raise typer.Exit(1 if failed else 0)


@app.command()
@plain_errors
def watch(
    rig: Annotated[str, typer.Argument(metavar="RIG", help="The rig's name, which is part of the key.")],
    connect: Connect = None,
    config: ConfigFile = None,
    key_prefix: KeyPrefix = None,
    client: AsClient = False,
    until_gone: Annotated[bool, typer.Option("--until-gone", help="End when the daemon does.")] = False,
    count: Annotated[int | None, typer.Option(min=1, help="End after so many tracks.")] = None,
    wait: Annotated[
        float | None,
        typer.Option(min=0, metavar="SECONDS", help="Wait so long for the daemon; else for ever."),
    ] = None,
    max_age: Annotated[
        float, typer.Option(min=0.001, metavar="SECONDS", help="An older track is shown as stale.")
    ] = 0.2,
    report: Annotated[Path | None, typer.Option(help="Write the summary there, as JSON.")] = None,
) -> None:
    """Show a rig's tracks as they arrive, until Ctrl-C, with what is fresh, missing, and how far the clocks differ."""
    from needletrack.config import load_config
    from needletrack.publish.tls import TlsFiles
    from needletrack.terminal import write_summary
    from needletrack.watch import watch as watch_tracks

    settings = load_config(config).subscribing
    summary = watch_tracks(
        rig,
        connect or settings.connect,
        key_prefix=key_prefix or settings.key_prefix,
        mode="client" if client else settings.mode,
        tls=TlsFiles.configured(settings.tls),
        until_gone=until_gone,
        count=count,
        wait_s=wait,
        max_age_s=max_age,
    )
    if report is None:
        typer.echo(summary, err=True)
    else:
        write_summary(summary, report)


@app.command()
@plain_errors
def control(
    rig: Annotated[str, typer.Argument(metavar="RIG", help="The rig's name, which is part of the key.")],
    command: Annotated[
        Literal["start-recording", "stop-recording", "snapshot", "re-detect", "needle"],
        typer.Argument(metavar="COMMAND", help="start-recording, stop-recording, snapshot, re-detect, or needle."),
    ],
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Of needle: the type to change to, or default.")
    ] = None,
    connect: Connect = None,
    config: ConfigFile = None,
    key_prefix: KeyPrefix = None,
    client: AsClient = False,
    token_file: Annotated[
        Path | None, typer.Option(help="File with the daemon's control token, where it asks for one.")
    ] = None,
    request_id: Annotated[
        str | None, typer.Option(help="Repeat a request: it is answered as before, and not done twice.")
    ] = None,
    timeout: Annotated[float, typer.Option(min=0.1, metavar="SECONDS", help="Wait so long for the answer.")] = 10.0,
) -> None:
    """Ask a running daemon to record, to take a snapshot, to detect anew, or to change the needle.

    The answer goes to stdout, as JSON. Exit code 0 where it was done; 1 where it failed; 2 where it was refused, or
    nobody answered.
    """
    from needletrack.client import Outcome
    from needletrack.client import control as ask
    from needletrack.config import load_config
    from needletrack.daemon.control import read_token
    from needletrack.publish.control import request_of
    from needletrack.publish.tls import TlsFiles

    token = None if token_file is None else read_token(token_file)
    request = request_of(command, needle=name, token=token, request_id=request_id)
    settings = load_config(config).subscribing
    reply = ask(
        rig,
        request,
        connect or settings.connect,
        key_prefix=key_prefix or settings.key_prefix,
        mode="client" if client else settings.mode,
        tls=TlsFiles.configured(settings.tls),
        timeout_s=timeout,
    )
    typer.echo(reply.to_json().decode())
    if reply.outcome is not Outcome.DONE:
        typer.echo(f"needletrack: {command} {reply.outcome.value} ({reply.code}): {reply.detail}", err=True)
        raise typer.Exit(1 if reply.outcome is Outcome.FAILED else 2)


@app.command()
@plain_errors
def router(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="Zenoh's own configuration, JSON5, of mode router.")],
) -> None:
    """Route between daemons and subscribers until SIGTERM or Ctrl-C, where no zenohd is at hand."""
    from needletrack.router import serve
    from needletrack.terminal import Interruption

    with Interruption() as interruption:
        serve(path, interruption.stop, lambda endpoints: typer.echo(f"routing on {', '.join(endpoints)}", err=True))


@security_app.command("init")
@plain_errors
def security_init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="New folder, or one to which a rig is added.")],
    rig: Annotated[str, typer.Option(help="The rig's name, as in its file.")],
    host: Annotated[
        list[str] | None,
        typer.Option(
            help="Name or address by which others reach the daemon or the router; may be repeated. "
            "Default: 127.0.0.1 and localhost, this machine alone."
        ),
    ] = None,
    key_prefix: Annotated[str, typer.Option(help="As publishing.key_prefix.")] = DEFAULT_PREFIX,
    days: Annotated[int, typer.Option(min=1, max=825, help="The certificates are valid for so long.")] = 90,
    port: Annotated[int, typer.Option(min=1, max=65534, help="Of tracks; pictures have the next one.")] = 7447,
    renew: Annotated[bool, typer.Option("--renew", help="Replace the rig's and the router's certificates.")] = False,
) -> None:
    """Make a TEST authority, a certificate for each of the rig's roles, and the access rules from its name.

    A folder a role: DIR/RIG/publisher, controller, operator, and DIR/router, each with what one machine needs.
    """
    from needletrack.authority import NOT_FOR_A_HOSPITAL, init_security

    hosts = host or ["127.0.0.1", "localhost"]
    for issued in init_security(folder, rig, hosts=hosts, key_prefix=key_prefix, days=days, port=port, renew=renew):
        typer.echo(f"{issued.name:32} {issued.folder}")
    typer.echo(f"\n{NOT_FOR_A_HOSPITAL}")


@security_app.command("list")
@plain_errors
def security_list(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `security init` made.")],
) -> None:
    """List the certificates of a folder, and how long each is valid. Exit code 1 where one has expired."""
    from needletrack.authority import expiries

    now, expired = datetime.now(UTC), False
    for path, name, until in expiries(folder):
        left = f"{(until - now).days} days left" if until > now else "EXPIRED: `needletrack security init ... --renew`"
        typer.echo(f"{name:32} until {until:%Y-%m-%d %H:%M} UTC, {left}  {path}")
        expired |= until <= now
    raise typer.Exit(1 if expired else 0)


@rig_app.command("show")
@plain_errors
def rig_show(path: RigPath) -> None:
    """Summarise a rig."""
    from needletrack.replay import rig_at

    _show_rig(rig_at(path))


@rig_app.command("import")
@plain_errors
def rig_import(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="Kalibr camchain, OpenCV FileStorage (one or two files), MATLAB .mat; or the left and the right "
            "camera's ROS camera_info or mrcal .cameramodel.",
        ),
    ],
    output: Annotated[Path, typer.Option(help="The rig file to write.")] = Path("rig.yaml"),
    name: Annotated[str | None, typer.Option(help="The rig's name; else its folder's.")] = None,
    size: Annotated[str | None, typer.Option(help="Of the images, e.g. 1280x1024, where no file says it.")] = None,
    unit_mm: Annotated[
        float | None, typer.Option(help="Millimetres in the files' unit of length, where it is not the usual one.")
    ] = None,
) -> None:
    """Make a rig file from another tool's calibration."""
    from needletrack.formats.exchange import import_rig
    from needletrack.rig import write_rig

    size_px = None if size is None else _numbers(size, "--size", "1280x1024, width and height")
    imported = import_rig(files, name or _rig_name(files[0].resolve().parent), size_px=size_px, unit_mm=unit_mm)
    write_rig(imported, output)
    _show_rig(imported)
    typer.echo(f"written: {output}")


@rig_app.command("export")
@plain_errors
def rig_export(
    path: RigPath,
    output: Annotated[Path, typer.Argument(metavar="OUTPUT", help="The file to write; the folder for ros and mrcal.")],
    kind: Annotated[
        Literal["kalibr", "ros", "opencv", "matlab", "mrcal"], typer.Option("--format", help="Whose format.")
    ],
) -> None:
    """Write a rig in another tool's format."""
    from needletrack.formats.exchange import export_rig
    from needletrack.replay import rig_at

    for written in export_rig(rig_at(path), kind, output):
        typer.echo(f"written: {written}")


@rig_app.command("check")
@plain_errors
def rig_check(path: RigPath, config: ConfigFile = None) -> None:
    """Check that a rig can be true, and that it sees some of the configured workspace."""
    from needletrack.config import load_config
    from needletrack.replay import rig_at

    checked = rig_at(path)
    settings = load_config(config)
    checked.require_view_of(settings.tracking.workspace)
    if warning := checked.age_warning(settings.rig.max_age_days, datetime.now(UTC)):
        typer.echo(f"warning: {warning}", err=True)
    typer.echo(f"{path}: ok, rig {checked.name}, digest {checked.digest}")


@config_app.command("show")
@plain_errors
def config_show(
    path: Annotated[Path | None, typer.Argument(metavar="PATH", help="TOML file; without it, the defaults.")] = None,
) -> None:
    """Print what is in effect, as JSON: defaults, file, and environment."""
    from needletrack.config import load_config

    typer.echo(load_config(path).model_dump_json(indent=2))


@config_app.command("check")
@plain_errors
def config_check(path: Annotated[Path, typer.Argument(metavar="PATH", help="TOML file.")]) -> None:
    """Check a configuration file, together with the environment's overrides."""
    from needletrack.config import load_config

    typer.echo(f"{path}: ok, digest {load_config(path).digest}")


@app.command()
@plain_errors
def calibrate(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="Recording of the board (folder, file of `record`, ROS bag), or the left camera's pictures; ten views "
            "or more.",
        ),
    ],
    right: Annotated[
        Path | None,
        typer.Argument(metavar="RIGHT", help="The right camera's pictures, where FOLDER has the left ones."),
    ] = None,
    *,
    square_mm: Annotated[float, typer.Option(help="Side of a square, mm: measure it.")],
    squares: Annotated[str, typer.Option(help="Squares across and down.")] = "11x11",
    marker_mm: Annotated[float | None, typer.Option(help="Side of a marker, mm: the board is a ChArUco board.")] = None,
    dictionary: Annotated[str, typer.Option(help="Dictionary of the ChArUco board's markers.")] = "DICT_5X5_1000",
    legacy: Annotated[bool, typer.Option("--legacy", help="ChArUco board as OpenCV drew it before 4.6.")] = False,
    output: Annotated[Path, typer.Option(help="The rig file to write.")] = Path("rig.yaml"),
    report: Annotated[Path | None, typer.Option(help="The HTML report; else beside the rig file.")] = None,
    name: Annotated[str | None, typer.Option(help="The rig's name; else the folder's.")] = None,
    lens: Annotated[
        Literal["auto", "4", "5", "8"],
        typer.Option(help="Terms of the distortion: 4 or 5 radial-tangential, 8 rational; auto: what the views carry."),
    ] = "auto",
    warp: Annotated[bool, typer.Option("--warp", help="Solve for the board's bend as well.")] = False,
    config: ConfigFile = None,
    stream: Annotated[
        Path | None,
        typer.Option(
            metavar="RECORDING",
            help="As --live, from a recording, played at its own pace.",
        ),
    ] = None,
    live: Annotated[
        bool,
        typer.Option(
            "--live",
            help="Take the views that add something from the configuration's cameras into FOLDER, a new one, with "
            "guidance, then calibrate. Ctrl-C ends it sooner.",
        ),
    ] = False,
    most: Annotated[
        int, typer.Option(min=4, help="Of a film, such as `record` makes: look at so many pairs, the stillest ones.")
    ] = 60,
) -> None:
    """Make a rig file from pictures of a checkerboard or a ChArUco board, and a report of what it is worth."""
    from rich.console import Console

    from needletrack.config import load_config
    from needletrack.recording.board import calibrate_from_pictures, open_board_pictures
    from needletrack.report.calibration import write_calibration_report
    from needletrack.rig import write_rig
    from needletrack.terminal import steps_shown

    board = _board(squares, square_mm, marker_mm, dictionary, legacy=legacy)
    settings = load_config(config)
    console = Console(stderr=True)
    if live or stream is not None:
        _collect(folder, right, board, settings, console, stream=stream, live=live)
    pictures = open_board_pictures(folder, right, most=most, tolerance_us=_tolerance_us(settings))
    with steps_shown(console, "looking for the board", len(pictures.names)) as progress:
        found = calibrate_from_pictures(
            pictures,
            board,
            name or _rig_name(folder.with_suffix("") if folder.is_file() else folder),
            datetime.now(UTC),
            lens=None if lens == "auto" else _TERMS[lens],
            warp=warp,
            workspace=settings.tracking.workspace,
            progress=progress,
        )
    write_rig(found.rig, output)
    page = report or output.with_name(f"{output.stem}-calibration.html")
    write_calibration_report(found, pictures, board, page)
    for sentence in found.left_out:
        typer.echo(f"left out: {sentence}", err=True)
    _show_rig(found.rig)
    for line in found.told():
        typer.echo(line)
    typer.echo(f"written: {output}, {page}")


@app.command()
@plain_errors
def check(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="Rig file.")],
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="One fresh pair of pictures of the board, or more, as for calibrate."),
    ],
    right: Annotated[Path | None, typer.Argument(metavar="RIGHT", help="As for calibrate.")] = None,
    *,
    square_mm: Annotated[float, typer.Option(help="Side of a square, mm.")],
    squares: Annotated[str, typer.Option(help="Squares across and down.")] = "11x11",
    marker_mm: Annotated[float | None, typer.Option(help="Side of a marker, mm, of a ChArUco board.")] = None,
    dictionary: Annotated[str, typer.Option(help="Dictionary of its markers.")] = "DICT_5X5_1000",
    legacy: Annotated[bool, typer.Option("--legacy", help="ChArUco board as OpenCV drew it before 4.6.")] = False,
    config: ConfigFile = None,
    live: Annotated[
        bool, typer.Option("--live", help="Take the views from the configuration's cameras into FOLDER, a new one.")
    ] = False,
    views: Annotated[int, typer.Option(min=1, help="So many views, live.")] = 3,
) -> None:
    """Check with a fresh picture pair of a board whether the cameras still stand as they were calibrated.

    Exit code 0 where they do; 1 where one has moved: calibrate anew, nothing is corrected in silence.
    """
    from rich.console import Console

    from needletrack.config import load_config
    from needletrack.recording.board import check_pictures, open_board_pictures
    from needletrack.replay import rig_at

    checked, settings = rig_at(rig), load_config(config)
    board = _board(squares, square_mm, marker_mm, dictionary, legacy=legacy)
    if warning := checked.age_warning(settings.rig.max_age_days, datetime.now(UTC)):
        typer.echo(f"warning: {warning}", err=True)
    if live:
        from needletrack.daemon.run import require_fit

        require_fit(checked, settings)
        _collect(folder, right, board, settings, Console(stderr=True), live=True, enough=views)
    pictures = open_board_pictures(folder, right, most=_CHECK_MOST, tolerance_us=_tolerance_us(settings))
    found = check_pictures(checked, pictures, board, settings.tracking.workspace)
    for line in found.told():
        typer.echo(line)
    if found.check.moved:
        raise typer.Exit(1)


@app.command()
@plain_errors
def register(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="Rig file.")],
    pairs: Annotated[
        Path,
        typer.Argument(
            metavar="PAIRS",
            help="CSV with rig_x_mm, rig_y_mm, rig_z_mm, robot_x_mm, robot_y_mm, robot_z_mm; robot_qx ... robot_qw "
            "as well where the robot states its flange, and the rig saw the tip of its tool.",
        ),
    ],
    frame_id: Annotated[str, typer.Option(help="The robot's frame, in which tracks are then published.")],
    output: Annotated[Path | None, typer.Option(help="The rig file to write; else RIG itself.")] = None,
) -> None:
    """Find where the rig stands in a robot's frame; tracks are then published in that frame."""
    from needletrack.recording.registration import read_pairs, registered
    from needletrack.rig import read_rig, write_rig

    placed, found = registered(read_rig(rig), read_pairs(pairs), frame_id, datetime.now(UTC))
    write_rig(placed, output or rig)
    for index, (residual, without) in enumerate(
        zip(found.residual_mm.tolist(), found.leave_one_out_mm.tolist(), strict=True), start=1
    ):
        typer.echo(f"pair {index:3}    {residual:8.3f} mm off, {without:8.3f} mm by the others alone")
    typer.echo(f"all         {found.rms_mm:8.3f} mm rms, {found.leave_one_out_rms_mm:8.3f} mm by the others alone")
    if found.tool_mm is not None:
        typer.echo(
            f"tool        tip at {', '.join(f'{value:.3f}' for value in found.tool_mm.tolist())} mm in the flange"
        )
    turn = " ".join(f"{value:.3f}" for value in found.turn_sigma_deg.tolist())
    shift = " ".join(f"{value:.3f}" for value in found.shift_sigma_mm.tolist())
    typer.echo(f"sigma       turn {turn} degrees, shift {shift} mm, about the robot's axes through the points' middle")
    typer.echo(f"written: {output or rig}; tracks are published in {frame_id}")


@app.command()
@plain_errors
def table1(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="Recording of stills.")] = LAB_RECORDING,
    repeats: Annotated[int, typer.Option(min=1, help="Runs of each stage; the median counts.")] = 9,
) -> None:
    """Repeat Table 1 of the 2017 paper, beside the paper's figures and our method."""
    from rich.console import Console

    from needletrack.table1 import render
    from needletrack.table1 import table1 as measured

    console = Console()
    # In a file or a pipe, a table is as wide as it needs to be.
    console = console if console.is_terminal else Console(width=_TABLE_WIDTH)
    console.print(render(measured(recording, repeats)))


@app.command()
def version() -> None:
    """Print the version."""
    typer.echo(__version__)


def _complain(error: Exception) -> None:
    typer.echo(f"needletrack: {error}", err=True)


def _board(squares: str, square_mm: float, marker_mm: float | None, dictionary: str, *, legacy: bool) -> "Board":
    from needletrack.calibration.board import CharucoBoard, Checkerboard

    across, down = _parsed(squares)
    if marker_mm is None:
        return Checkerboard(across, down, square_mm)
    return CharucoBoard(across, down, square_mm, marker_mm, dictionary, legacy)


def _collect(
    folder: Path,
    right: Path | None,
    board: "Board",
    settings: "Config",
    console: "Console",
    *,
    stream: Path | None = None,
    live: bool,
    enough: int | None = None,
) -> None:
    """Views with guidance into the folder; raises CalibrationError where none was taken."""
    from needletrack.daemon.board import collect_live
    from needletrack.guidance import GuidanceShown, collect
    from needletrack.recording.board import BoardRecorder, board_stream
    from needletrack.terminal import Interruption, warnings_shown

    if right is not None or (live and stream is not None):
        raise CalibrationError("--live and --stream take the views themselves: give one of them, and one new folder")
    with Interruption() as interruption, GuidanceShown(console) as shown, warnings_shown(console):
        if stream is None:
            last = collect_live(settings, board, folder, interruption.stop, shown.take, enough=enough)
        else:
            last = collect(board_stream(stream), board, BoardRecorder(folder), interruption.stop, shown.take)
    if last is None or not last.accepted:
        said = "no pair came" if last is None else f"of the last pair: {last.said}"
        raise CalibrationError(f"no view of the board was taken ({said})")
    typer.echo(f"{folder}: {last.accepted} views taken", err=True)


def _tolerance_us(settings: "Config") -> float:
    """Of pairs that were taken with these settings, whose right stamps may be later by a constant."""
    return settings.pairing.tolerance_us + abs(settings.pairing.offset_us)


def _rig_name(folder: Path) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "-", folder.resolve().name).strip("-._") or "rig"


def _rig_for(path: Path | None, config: "Config") -> "Rig":
    from needletrack.replay import rig_at

    chosen = path or config.rig.path
    if chosen is None:
        raise CalibrationError("no rig: name one with --rig, or rig.path in the configuration")
    return rig_at(chosen)


def _counts(counts: "Mapping[DropReason, int]") -> str:
    return ", ".join(f"{reason.value} {count}" for reason, count in counts.items()) or "none"


def _parsed(squares: str) -> tuple[int, int]:
    return _numbers(squares, "--squares", "11x11, squares across and down")


def _numbers(text: str, option: str, wanted: str) -> tuple[int, int]:
    across, _, down = text.lower().partition("x")
    if not (across.isdecimal() and down.isdecimal()):
        raise CalibrationError(f"{option} {text!r}: write it as {wanted}")
    return int(across), int(down)


def _show_rig(rig: "Rig") -> None:
    typer.echo(f"rig         {rig.name}, digest {rig.digest}")
    for side, camera in (("left", rig.left), ("right", rig.right)):
        (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
        width, height = camera.size_px
        lens = " ".join(f"{coefficient:.5g}" for coefficient in camera.distortion)
        matrix = f"f {fx:.2f} {fy:.2f} px, centre {cx:.2f} {cy:.2f} px"
        typer.echo(f"{side:11} {width}x{height} px, {matrix}, distortion {lens}")
    apart = degrees(acos(min(rig.right_from_left.rotation[2, 2], 1.0)))
    typer.echo(f"pose        baseline {rig.baseline_mm:.2f} mm, optical axes {apart:.2f}° apart")
    info, facts = rig.calibration, []
    facts.append(f"by {info.method}")
    if info.calibrated_at is not None:
        facts.append(f"{info.calibrated_at:%Y-%m-%d %H:%M %Z}")
    if info.reprojection_rms_px is not None:
        facts.append(f"{info.reprojection_rms_px:.3f} px rms")
    if info.views is not None:
        facts.append(f"{info.views} views")
    typer.echo(f"calibrated  {', '.join([*facts, info.source] if info.source else facts)}")
    stated = info.uncertainty
    if stated is not None and stated.before_alignment_mm is not None and stated.after_alignment_mm is not None:
        typer.echo(
            f"to expect   {stated.before_alignment_mm:.3f} mm rms in the workspace, {stated.after_alignment_mm:.3f} mm "
            "after the best rigid alignment"
        )
    if (placed := rig.registration) is not None:
        typer.echo(f"registered  to {placed.frame_id}, {len(placed.points_mm)} points, {placed.rms_mm:.3f} mm rms")
