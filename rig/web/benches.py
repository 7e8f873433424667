"""The overview of several benches. This server asks the others: a browser does not show a page what they answer."""

import asyncio
import json
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from typing import Any, Final
from urllib.parse import SplitResult, urlsplit

from rig.web.answers import BenchStatus, OtherBench
from rig.web.server import API

ANSWER_S: Final = 2.0  # longer: one bench that is switched off delays the page; shorter: a busy bench looks dead
FRESH_S: Final = 2.0
"""Age up to which an answer is used again, so that many pages ask no more often than one."""
JOBS: Final = 20  # the newest ones: unless more wait, the running job and the last answer are among them
MAX_BYTES: Final = 4_000_000  # a larger answer is none of these lists


class OtherBenches:
    """Asks the servers at some addresses, by name, for state, running job and last answer.

    The user part of an address may hold the token for its server.
    """

    def __init__(self, addresses: Mapping[str, str]) -> None:
        self._addresses = {name: urlsplit(address) for name, address in addresses.items()}
        # One thread for each: a name that is not found in the network blocks a thread for longer than `ANSWER_S`.
        self._threads = ThreadPoolExecutor(max(len(addresses), 1), thread_name_prefix="benches")
        self._asked: dict[str, tuple[float, Future[OtherBench]]] = {}

    async def overview(self) -> list[OtherBench]:
        """Return what the benches answer within `ANSWER_S`, or answered just before, in the order of the addresses."""
        now_s = asyncio.get_running_loop().time()
        for name, address in self._addresses.items():
            asked_s, answer = self._asked.get(name, (now_s, None))
            if answer is None or (answer.done() and now_s - asked_s > FRESH_S):
                self._asked[name] = now_s, self._threads.submit(_ask, name, address)
        answers = {name: answer for name, (_, answer) in self._asked.items()}
        if answers:
            await asyncio.wait([asyncio.wrap_future(one) for one in answers.values()], timeout=ANSWER_S)
        return [
            answers[name].result() if answers[name].done() else _bench(name, address, "does not answer")
            for name, address in self._addresses.items()
        ]


def _bench(name: str, address: SplitResult, problem: str | None = None) -> OtherBench:
    return OtherBench(name=name, address=f"{address.scheme}://{_place(address)}/", problem=problem)


def _place(address: SplitResult) -> str:
    return address.netloc.rpartition("@")[2]


def _ask(name: str, address: SplitResult) -> OtherBench:
    connect = HTTPSConnection if address.scheme == "https" else HTTPConnection
    connection = connect(_place(address), timeout=ANSWER_S)
    try:
        status = _get(connection, "/status", address.password)
        jobs = _get(connection, f"/jobs?limit={JOBS}", address.password)["items"]
        # Another version of the server may say more.
        known = {key: value for key, value in status.items() if key in BenchStatus.model_fields}
        bench = _bench(name, address)
        bench.status = BenchStatus.model_validate(known)
        for job in jobs:
            if job["id"] == status["job"]:
                bench.job = " ".join(filter(None, (job["request"]["kind"], job["request"].get("name"))))
        answered = next((one for one in jobs if one["request"]["kind"] == "identify" and one["result_text"]), None)
        if answered is not None:
            bench.answer, bench.answered_utc = answered["result_text"].partition("\n")[0], answered["ended_utc"]
    except OSError as error:
        return _bench(name, address, f"does not answer: {error.strerror or error}")
    except _Rejected as error:
        return _bench(name, address, str(error))
    except (HTTPException, ValueError, TypeError, KeyError, AttributeError):
        return _bench(name, address, "is no bench, or has another version")
    finally:
        connection.close()
    return bench


class _Rejected(Exception):
    """The other server answers with an error."""


def _get(connection: HTTPConnection, path: str, token: str | None) -> Any:
    connection.request("GET", f"{API}{path}", headers={"Authorization": f"Bearer {token}"} if token else {})
    answer = connection.getresponse()
    values = json.loads(answer.read(MAX_BYTES))
    if answer.status != 200:
        raise _Rejected(f"answers {answer.status}: {values['detail']}")
    return values
