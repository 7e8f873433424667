"""`rig serve`."""

import ipaddress
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.core.errors import ExtraMissing, UsageError
from rig.core.next_steps import Do

DEFAULT_PORT = 8420  # any number that few other services use


@command
def serve(
    settings: Settings,
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Address to listen to. Other computers need a token.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port to listen to; 0 chooses a free one.")
    ] = DEFAULT_PORT,
    allow_host: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Other host name of this server. Repeatable.")
    ] = None,
    certfile: Annotated[
        Path | None, typer.Option(metavar="FILE", help="TLS certificate chain, PEM. Needs --keyfile.")
    ] = None,
    keyfile: Annotated[Path | None, typer.Option(metavar="FILE", help="Private key of the certificate, PEM.")] = None,
    login: Annotated[
        bool, typer.Option("--login", help="Require a token on this computer, too: it has several users.")
    ] = False,
    new_token: Annotated[
        str | None, typer.Option("--new-token", metavar="NAME", help="Make a token, print it once, and stop.")
    ] = None,
    role: Annotated[Literal["watch", "propose", "operate"], typer.Option(help="What the new token allows.")] = "watch",
    days: Annotated[
        float | None, typer.Option(min=0.01, max=3650, help="How many days the new token is valid (default: always).")
    ] = None,
    remove_token: Annotated[
        str | None, typer.Option("--remove-token", metavar="NAME", help="Remove a token, and stop.")
    ] = None,
) -> None:
    """Serve the bench to browsers and other programs: pages, REST API and events. Ctrl+C stops the server.

    The server listens to this computer only, unless --host says otherwise. Needs the extra hbr-rig[web].

    Example: rig serve --bench sim

    Example: rig serve --new-token tablet --role operate
    """
    try:
        import fastapi  # noqa: F401
        import uvicorn  # noqa: F401
    except ImportError as error:
        raise ExtraMissing.of("web", "Servers", error) from error
    from rig.config.values import FILE_NAME, default_path
    from rig.safety.saved_state import SERVER_FOLDER
    from rig.web.access import Role, Tokens
    from rig.web.run import run_server
    from rig.web.setup import Setup

    # Tokens: these options change the stored ones, and start no server.
    folder = settings.load().state_path(settings.bench_name) / SERVER_FOLDER
    tokens = Tokens(folder, SystemClock())
    if new_token is not None:
        token = tokens.new(new_token, Role(role), days)
        settings.say(token, {"name": new_token, "role": role, "token": token})
        print("This is the only time that the token is shown. Keep it secret.", file=sys.stderr)
        return
    if remove_token is not None:
        if not tokens.remove(remove_token):
            raise UsageError(f"There is no token {remove_token!r}.", next_step="Check the name.")
        settings.say(f"Removed the token {remove_token}.", {"removed": remove_token})
        return
    if (certfile is None) != (keyfile is None):
        raise UsageError("TLS needs a certificate and its key.", next_step="Give --certfile and --keyfile.")
    # Every user of the network could move the table, so only this computer may do without tokens.
    needs_login = login or not is_loopback(host)
    if needs_login and not tokens.stored():
        raise UsageError(
            f"Everybody at {host} needs a token, and there is none.", next_step=Do.NEW_TOKEN(role="operate")
        )
    name = settings.bench_name
    if name in ("sim", "photographs") and "speed" not in settings.load().bench.get(name, {}):
        settings = settings.merged(overrides=[f"bench.{name}.speed=1"])  # people watch it
    # The web process runs with the same settings.
    arguments = tuple(settings.arguments())
    settings.opened.append(settings.bench_name)

    def announce(url: str) -> None:
        print(f"The bench is at {url}. Stop with Ctrl+C.", file=sys.stderr, flush=True)
        if not needs_login:
            text = "Every user of this computer can operate the bench there. With --login, each needs a token."
            print(text, file=sys.stderr, flush=True)

    if settings.load().serve.find:
        try:
            import zeroconf  # noqa: F401
        except ImportError as error:
            raise ExtraMissing.of("mdns", "Benches in the network", error) from error
    setup = Setup(
        bench=settings.bench_name,
        config=settings.load(),
        config_file=(settings.config or default_path() or Path(FILE_NAME)).absolute(),
        seed=settings.seed,
        arguments=arguments,
        host=host,
        port=port,
        other_hosts=tuple(allow_host or ()),
        certfile=certfile,
        keyfile=keyfile,
        needs_login=needs_login,
    )
    run_server(setup, announce)


def is_loopback(host: str) -> bool:
    """Return whether only this computer can reach an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
