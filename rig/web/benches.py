"""The overview of several benches. This server asks the others: a browser does not show a page what they answer."""

import asyncio
import json
import re
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from typing import Any, Final, NamedTuple
from urllib.parse import SplitResult, urlsplit

from pydantic import BaseModel

from rig.web.answers import BenchStatus
from rig.web.server import API

ANSWER_S: Final = 2.0  # longer: one bench that is switched off delays the page; shorter: a busy bench looks dead
FRESH_S: Final = 2.0
"""Age up to which an answer is used again, so that many pages ask no more often than one."""
JOBS: Final = 20  # the newest ones: unless more wait, the running job and the last answer are among them
SERVICE: Final = "_hbr-rig._tcp.local."
"""What a server announces, without TLS, as in docs/deploy/rig-avahi.service."""
HOST: Final = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9.-]*[A-Za-z0-9])?")
MAX_FOUND: Final = 50  # a device that announces many names must not fill the page
MAX_BYTES: Final = 4_000_000  # a larger answer is none of these lists


class OtherBench(BaseModel):
    """A bench of the overview. ``problem`` says why its state is not known; then the rest is null.

    ``job`` is the running job, ``answer`` the last answer of a recent identification, both in words; ``answered_utc``
    is null while that job runs.
    """

    name: str
    address: str
    problem: str | None = None
    status: BenchStatus | None = None
    job: str | None = None
    answer: str | None = None
    answered_utc: str | None = None


class _Place(NamedTuple):
    """The address of a server, and its numeric address if the network has told it."""

    address: SplitResult
    numeric: str | None = None

    @property
    def host(self) -> str:
        """Host and port, as the server is called: without the user part of the address."""
        return self.address.netloc.rpartition("@")[2]


class BenchesInNetwork:
    """The servers that announce themselves in the local network by multicast DNS, by their names there.

    It asks on all ``interfaces``, or on those with these addresses. Needs the extra hbr-rig[mdns].
    """

    def __init__(self, interfaces: Sequence[str] | None = None) -> None:
        from zeroconf import InterfaceChoice, ServiceBrowser, Zeroconf

        self._found: dict[str, _Place] = {}
        self._network = Zeroconf(interfaces or InterfaceChoice.All)
        ServiceBrowser(self._network, SERVICE, handlers=[self._changed])

    def places(self) -> dict[str, _Place]:
        """Return those that have announced themselves so far, and have not left."""
        return self._found.copy()

    def close(self) -> None:
        self._network.close()

    # The library calls it with these names, in a thread of its own.
    def _changed(self, zeroconf: Any, service_type: str, name: str, state_change: Any) -> None:
        title = name.removesuffix(f".{service_type}")
        info = None if state_change.name == "Removed" else zeroconf.get_service_info(service_type, name)
        if info is None or not (numeric := info.parsed_addresses()):
            self._found.pop(title, None)
        # Every device of the network can announce anything.
        elif len(self._found) < MAX_FOUND and title.isprintable() and HOST.fullmatch(host := info.server.rstrip(".")):
            self._found[title] = _Place(urlsplit(f"http://{host}:{info.port}"), numeric[0])


class OtherBenches:
    """Asks the servers at some addresses, by name, for state, running job and last answer.

    The user part of an address may hold the token for its server. Those ``in_network`` are asked without a token.
    """

    def __init__(self, addresses: Mapping[str, str], in_network: BenchesInNetwork | None = None) -> None:
        self._named = {name: _Place(urlsplit(address)) for name, address in addresses.items()}
        self._in_network = in_network
        # One thread for each: a name that is not found in the network blocks a thread for longer than `ANSWER_S`.
        threads = len(addresses) + (MAX_FOUND if in_network else 1)
        self._threads = ThreadPoolExecutor(threads, thread_name_prefix="benches")
        self._asked: dict[str, tuple[float, Future[OtherBench]]] = {}

    async def overview(self) -> list[OtherBench]:
        """Return what the benches answer within `ANSWER_S`, or answered just before: first those that are named."""
        now_s = asyncio.get_running_loop().time()
        places = self._places()
        self._asked = {name: asked for name, asked in self._asked.items() if name in places}
        for name, place in places.items():
            asked_s, answer = self._asked.get(name, (now_s, None))
            if answer is None or (answer.done() and now_s - asked_s > FRESH_S):
                self._asked[name] = now_s, self._threads.submit(_ask, name, place)
        answers = {name: self._asked[name][1] for name in places}
        # A bench that is late is asked no second time: its answer counts when the page asks again.
        if answers:
            await asyncio.wait([asyncio.wrap_future(one) for one in answers.values()], timeout=ANSWER_S)
        return [
            answers[name].result() if answers[name].done() else _bench(name, place, "does not answer")
            for name, place in places.items()
        ]

    def _places(self) -> dict[str, _Place]:
        found = {} if self._in_network is None else self._in_network.places()
        known = {place.host for place in self._named.values()}
        others = {name: place for name, place in sorted(found.items()) if place.host not in known}
        return {**self._named, **{name: place for name, place in others.items() if name not in self._named}}


def _bench(name: str, place: _Place, problem: str | None = None) -> OtherBench:
    return OtherBench(name=name, address=f"{place.address.scheme}://{place.host}/", problem=problem)


def _ask(name: str, place: _Place) -> OtherBench:
    connect = HTTPSConnection if place.address.scheme == "https" else HTTPConnection
    numeric = place.numeric and f"[{place.numeric}]" if ":" in (place.numeric or "") else place.numeric
    connection = connect(f"{numeric}:{place.address.port}" if numeric else place.host, timeout=ANSWER_S)
    try:
        status = _get(connection, "/status", place)
        jobs = _get(connection, f"/jobs?limit={JOBS}", place)["items"]
        # Another version of the server may say more.
        known = {key: value for key, value in status.items() if key in BenchStatus.model_fields}
        bench = _bench(name, place)
        bench.status = BenchStatus.model_validate(known)
        for job in jobs:
            if job["id"] == status["job"]:
                bench.job = " ".join(filter(None, (job["request"]["kind"], job["request"].get("name"))))
        answered = next((one for one in jobs if one["request"]["kind"] == "identify" and one["result_text"]), None)
        if answered is not None:
            bench.answer, bench.answered_utc = answered["result_text"].partition("\n")[0], answered["ended_utc"]
    except OSError as error:
        return _bench(name, place, f"does not answer: {error.strerror or error}")
    except _Rejected as error:
        return _bench(name, place, str(error))
    except (HTTPException, ValueError, TypeError, KeyError, AttributeError):
        return _bench(name, place, "is no bench, or has another version")
    finally:
        connection.close()
    return bench


class _Rejected(Exception):
    """The other server answers with an error."""


def _get(connection: HTTPConnection, path: str, place: _Place) -> Any:
    headers = {"Host": place.host}  # a server does not answer to its numeric address
    if place.address.password:
        headers["Authorization"] = f"Bearer {place.address.password}"
    connection.request("GET", f"{API}{path}", headers=headers)
    answer = connection.getresponse()
    values = json.loads(answer.read(MAX_BYTES))
    if answer.status != 200:
        raise _Rejected(f"answers {answer.status}: {values['detail']}")
    return values
