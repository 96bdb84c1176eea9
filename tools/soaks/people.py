"""What people ask for during the day: anything, now and then something senseless, sometimes two at once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from soaks.stage import ANSWERED_S, PEOPLE

if TYPE_CHECKING:
    from collections.abc import Callable

    from soaks.stage import Stage

WARMER_C = 2.0


def visit(stage: Stage) -> None:
    """Let somebody ask for something, sometimes while something else is being done."""
    chance = stage.chance
    wishes: dict[str, Callable[[], dict[str, Any]]] = {
        "focus": lambda: _focus(stage),
        "move": lambda: {"to_um": stage.somewhere_um()},
        "jog": lambda: {"by_um": float(chance.normal(0, 100))},
        "preset": lambda: {"action": "save", "name": f"p{chance.integers(3)}"},
        "stop": dict,
        "cancel": dict,
        "lease": lambda: {"action": "acquire", "seconds": 60.0},
        "temperature": lambda: {"celsius": stage.warm(float(chance.normal(0, WARMER_C)))},
        "map": lambda: {"max_width": 64},
        "runs": dict,
        "metrics": dict,
        "status": dict,
        "record": lambda: {"seconds": 0.05},
    }
    method = str(chance.choice(list(wishes)))
    stage.ask(method, **wishes[method]())
    if chance.random() < 0.5:  # and before that has begun, or in the middle of it, something else
        stage.ask(str(chance.choice(["focus", "home", "cancel", "stop"])))
    if chance.random() < 0.3:
        stage.engine.gone(PEOPLE[int(chance.integers(len(PEOPLE)))])
    stage.until(lambda: not stage.waiting, ANSWERED_S)
    if stage.engine.situation.fault is None:
        stage.ask("mode", mode="continuous")


def _focus(stage: Stage) -> dict[str, Any]:
    """Ask for focus as people do: somewhere, nowhere (25), to be given up when they go (35)."""
    chance = stage.chance
    params: dict[str, Any] = {"on_disconnect": "cancel" if chance.random() < 0.5 else "finish"}
    regions = {"beyond the sensor": (400, 0, 64, 64), "one pixel": (10, 10, 1, 1), "a part": (30, 20, 96, 72)}
    if chance.random() < 0.3:
        x, y, width, height = regions[str(chance.choice(list(regions)))]
        params["roi"] = {"x": x, "y": y, "width": width, "height": height}
    return params
