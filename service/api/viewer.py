"""The viewer page: static files beside this module, each under its own name."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter
from starlette.responses import FileResponse

from service.errors import NotFoundError

router = APIRouter(include_in_schema=False)

_FOLDER = Path(__file__).resolve().parent
_REVALIDATE = {"Cache-Control": "no-cache"}


@router.get("/")
async def page() -> FileResponse:
    """The page itself."""
    return FileResponse(_FOLDER / "viewer.html", headers=_REVALIDATE)


@router.get("/viewer{name:path}")
async def asset(name: str) -> FileResponse:
    """One of the page's scripts and styles."""
    for path in (*_FOLDER.glob("viewer*.js"), *_FOLDER.glob("viewer*.css")):
        if path.name == f"viewer{name}":
            return FileResponse(path, headers=_REVALIDATE)
    raise NotFoundError("the viewer page has no such file.", field="path", remedy="Open the page at /.")
