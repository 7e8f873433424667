"""Tokens, logins, roles and the lease."""

import stat

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from rig.core.errors import ConfigError, LeaseHeld, LoginRequired, UsageError
from rig.web.access import LEASE_S, SESSION_S, Lease, Person, Role, Sessions, Tokens
from sim.clock import VirtualClock


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def sessions(tmp_path, clock):
    return Sessions(Tokens(tmp_path, clock), clock, "rig_local")


def test_token_is_stored_as_a_hash_in_a_private_file(tmp_path, sessions):
    token = sessions.tokens.new("tablet", Role.WATCH)
    (file,) = tmp_path.iterdir()
    assert token not in file.read_text()
    assert token.removeprefix("rig_") not in file.read_text()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_token_gives_its_role_until_it_expires_or_is_removed(sessions, clock):
    token = sessions.tokens.new("robot", Role.OPERATE, days=1)
    secret, person = sessions.login(token)
    assert person == Person("robot", Role.OPERATE)
    assert sessions.find(secret) == person
    assert sessions.find("other") is None
    clock.sleep(SESSION_S + 1)
    assert sessions.find(secret) is None
    secret, _ = sessions.login(token)
    sessions.tokens.remove("robot")
    assert sessions.find(secret) is None
    token = sessions.tokens.new("robot", Role.OPERATE, days=1)
    clock.sleep(86401)
    with pytest.raises(LoginRequired):
        sessions.login(token)


def test_wrong_tokens_lock_no_one_out(sessions):
    token = sessions.tokens.new("tablet", Role.WATCH)
    for _ in range(20):
        with pytest.raises(LoginRequired):
            sessions.login("rig_wrong")
    assert sessions.login(token)[1].name == "tablet"


@pytest.mark.parametrize("content", [b"", b"[", b"{}", b'[{"name": "x"}]', b"\xff\xfe"])
def test_damaged_tokens_are_reported_and_allow_no_login(tmp_path, sessions, content):
    (tmp_path / "tokens.json").write_bytes(content)
    with pytest.raises(ConfigError):
        sessions.login("rig_x")


def test_damaged_tokens_change_nothing_for_those_who_have_one(tmp_path, sessions, clock):
    token = sessions.tokens.new("tablet", Role.OPERATE, days=1)
    secret, person = sessions.login(token)
    (tmp_path / "tokens.json").write_bytes(b"[")
    assert sessions.find(secret) == person
    assert sessions.verify(token).name == "tablet"
    with pytest.raises(ConfigError, match="cannot be read"):
        sessions.verify("rig_wrong")
    clock.sleep(SESSION_S / 2)
    assert sessions.find(secret) == person
    clock.sleep(86400)
    assert sessions.find(secret) is None  # it has expired all the same
    (tmp_path / "tokens.json").unlink()
    with pytest.raises(LoginRequired):
        sessions.verify(token)


@pytest.mark.parametrize(
    "name", ["a\x07b", "a\nb", "\u202eadmin", "\u200bx", " a", "a ", "", "x" * 51, "local", "LOCAL"]
)
def test_name_of_a_token_can_be_read_and_is_not_that_of_the_computer(sessions, name):
    with pytest.raises(UsageError):
        sessions.tokens.new(name, Role.WATCH)


def test_name_with_a_slash_is_not_another_persons_key():
    lease = Lease(VirtualClock(), lambda _values: None)
    lease.take(Person("tablet", Role.OPERATE, "1/2"))
    with pytest.raises(LeaseHeld):
        lease.take(Person("tablet/1", Role.OPERATE, "2"))


class LeaseMachine(RuleBasedStateMachine):
    """At most one person has the lease, and keeps it until it expires, is taken or given back."""

    def __init__(self):
        super().__init__()
        self.clock = VirtualClock()
        self.events = []
        self.lease = Lease(self.clock, self.events.append)
        self.holder, self.until = None, 0.0

    people = st.sampled_from(
        [Person("a", Role.OPERATE, "1"), Person("a", Role.OPERATE, "2"), Person("b", Role.OPERATE)]
    )

    def _expire(self):
        if self.holder is not None and self.clock.now_ns() * 1e-9 > self.until:
            self.holder = None

    @rule(person=people, force=st.booleans())
    def take(self, person, force):
        self._expire()
        if self.holder not in (None, person) and not force:
            with pytest.raises(LeaseHeld):
                self.lease.take(person)
            return
        self.lease.take(person, force=force)
        if self.holder != person:
            assert self.events[-1]["client"] == person.client
            assert self.events[-1]["taken_from"] == (self.holder.as_json() if self.holder else None)
        self.holder, self.until = person, self.clock.now_ns() * 1e-9 + LEASE_S

    @rule(person=people)
    def release(self, person):
        self._expire()
        self.lease.release(person)
        if self.holder == person:
            self.holder = None

    @rule(seconds=st.floats(0.1, 60))
    def wait(self, seconds):
        self.clock.sleep(seconds)

    @invariant()
    def one_holder(self):
        self._expire()
        assert self.lease.holder == self.holder


TestLease = LeaseMachine.TestCase
TestLease.settings = settings(max_examples=20, stateful_step_count=25, deadline=None)
