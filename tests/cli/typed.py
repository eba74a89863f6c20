"""Helpers to run commands, and a stand-in for the functions that commands call."""

from __future__ import annotations

from typing import Any

import pytest

from mitsplat.cli import main


def run(*args: object) -> int:
    with pytest.raises(SystemExit) as exited:
        main([str(arg) for arg in args])
    return int(exited.value.code or 0)


class Calls:
    """Stand-in for a function that records the arguments of its last call."""

    def __init__(self, result: Any = None, error: BaseException | None = None) -> None:
        self.result, self.error = result, error
        self.args: tuple[Any, ...] = ()
        self.kwargs: dict[str, Any] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.args, self.kwargs = args, kwargs
        if self.error is not None:
            raise self.error
        return self.result
