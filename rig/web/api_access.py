"""The REST API: logins, the lease, the health of the server."""

from importlib.metadata import version
from typing import Any

from fastapi import Request, Response

from rig.web.server import COOKIE, HandOverBody, LeaseBody, LoginBody, Routes, Server, Watcher, require_operate


def add_access(routes: Routes, server: Server) -> None:
    @routes.public.get("/health", tags=["server"])
    def health() -> dict[str, Any]:
        """Return whether the server works; needs no login."""
        status = server.remote.status
        return {"status": "ok", "version": version("hbr-rig"), "bench_open": bool(status.get("open"))}

    @routes.public.post("/login", tags=["access"])
    def login(body: LoginBody, response: Response) -> dict[str, Any]:
        """Log in with a token; the answer sets a cookie."""
        secret, person = server.sessions.login(body.token)
        response.set_cookie(COOKIE, secret, httponly=True, samesite="strict", secure=server.secure_cookies, path="/")
        return {"name": person.name, "role": person.role}

    @routes.public.post("/logout", tags=["access"])
    def logout(request: Request, response: Response) -> dict[str, Any]:
        """Log out. The open streams of this login end."""
        server.sessions.logout(request.cookies.get(COOKIE, ""))
        server.hub.wake()
        response.delete_cookie(COOKIE, path="/")
        return {}

    @routes.watch.get("/me", tags=["access"])
    def me(person: Watcher) -> dict[str, Any]:
        """Return who is logged in, and who has the lease."""
        mine = server.lease.is_held_by(person)
        return {"name": person.name, "role": person.role, "has_lease": mine, "lease": server.lease.as_json()}

    @routes.watch.get("/lease", tags=["access"])
    def lease() -> dict[str, Any]:
        """Return who has the lease."""
        return server.lease.as_json()

    @routes.watch.post("/lease", tags=["access"])
    def take_lease(body: LeaseBody, person: Watcher) -> dict[str, Any]:
        """Take or renew the lease."""
        require_operate(person)
        server.lease.take(person, force=body.force)
        return server.lease.as_json()

    @routes.watch.post("/lease/ask", tags=["access"])
    def ask_lease(person: Watcher) -> dict[str, Any]:
        """Ask the operator who has the lease to hand it over."""
        require_operate(person)
        server.lease.ask(person)
        return server.lease.as_json()

    @routes.watch.post("/lease/hand-over", tags=["access"])
    def hand_over(body: HandOverBody, person: Watcher) -> dict[str, Any]:
        """Give the lease to an operator who asked for it."""
        server.lease.hand_over(person, body.name, body.client)
        return server.lease.as_json()

    @routes.watch.delete("/lease", tags=["access"])
    def release(person: Watcher) -> dict[str, Any]:
        """Give the lease back."""
        server.lease.release(person)
        return server.lease.as_json()
