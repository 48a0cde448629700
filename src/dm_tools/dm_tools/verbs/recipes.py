"""`dm recipes`: build recipes on the bench, and list those of the calibration in use."""

import math
from contextlib import suppress
from typing import Annotated, Any

import typer

from dm_common.errors import Refusal
from dm_common.figures import counted, with_point
from dm_tools.output import (
    JsonOption,
    NamespaceOption,
    TakeOverOption,
    console,
    figures,
    next_step,
    progress_bar,
    write_json,
)
from dm_tools.parameter_changes import get_parameter
from dm_tools.running_suite import naming_holder, running_suite, usual_spheres

#: Rounds that a recipe takes, on average of simulated mirrors.
ROUNDS = 2


def curvatures_of(text: str) -> list[float]:
    """Curvatures (1/m) from a list such as "-0.02,0,0.02", or from first:last:number. Raises typer.BadParameter."""
    parts = (with_point(text) if ":" in text else text).split(":")
    try:
        if len(parts) == 1:
            listed = [float(with_point(part)) for part in text.split(",") if part.strip()]
            if not listed or not all(map(math.isfinite, listed)) or max(map(abs, listed)) >= 1.0:  # such as 0,02
                raise ValueError
            return listed
        first, last, number = float(parts[0]), float(parts[1]), int(parts[2])
    except (ValueError, IndexError) as error:
        raise typer.BadParameter(
            f"curvatures = {text!r}: must be like -0.02,0,0.02, below 1 1/m, or like -0.05:0.05:11"
        ) from error
    if len(parts) != 3 or not (2 <= number <= 1000 and math.isfinite(first) and math.isfinite(last)):
        raise typer.BadParameter(f"curvatures = {text!r}: must be first:last:number, the number 2 to 1000")
    step = (last - first) / (number - 1)
    return [round(first + k * step, 12) for k in range(number)]


def _build(client: Any, curvatures: list[float], conic: float, zernike: list[float], **options: Any) -> Any:
    """Build with a progress bar; `options` as of `build_recipes` of the client. Returns the action's result."""
    from dm_tools.long_actions import recipe_step

    with progress_bar() as progress:
        task, said = progress.add_task("recipes", total=len(curvatures)), ""

        def show(feedback: Any) -> None:
            nonlocal said
            text = recipe_step(feedback, zernike)
            if not console.is_terminal and text != said:  # no bar is drawn
                said = text
                console.print(f"recipe {text}")
            progress.update(task, completed=feedback.recipes, description=f"recipe {text}")

        result = client.build_recipes(curvatures, conic, zernike, on_feedback=show, **options)
        progress.update(task, completed=len(curvatures), description="recipes: done")
    return result


def expected_run(client: Any, number: int) -> str:
    """Expected duration of a run of this many recipes: a round is a degauss, a wait and the maps that are averaged."""
    wanted = {"focus_controller": ("converge.settle_time", "recipes.average"), "calibration": ("map_time",)}
    settle, average, each = (get_parameter(client, node, name) for node, names in wanted.items() for name in names)
    duration = ROUNDS * number * (client.capabilities.condition_time + settle + average * each)
    return f"{counted(number, 'recipe')} in about {duration:.0f} s if a map takes {each:g} s"


def _figures(book: Any) -> dict[str, Any]:
    recipes = [
        figures(recipe, "curvature", "conic_constant", "max_zernike_nm", "rms_nm", "maps")
        | {"zernike_nm": [1e9 * term for term in recipe.zernike]}
        for recipe in book.recipes
    ]
    return figures(book, "degauss_steps", "interpolation_error_nm") | {"recipes": recipes}


def next_of(book: Any) -> str:
    """What to do next, given the recipes of the calibration in use, a dm_msgs/RecipeBook."""
    if book.recipes:
        spheres = (each.curvature for each in book.recipes if not (each.conic_constant or any(each.zernike)))
        if (sphere := next(spheres, None)) is None:
            return "requests of these shapes with `mode: conditioned` use them (docs/recipes.md)"
        return f"./dm focus {sphere:g} --conditioned, or `mode: conditioned` of a request, uses them"
    if not book.calibration_id:
        return "./dm calibrate"
    return "./dm check shows why (docs/stay-true.md)" if book.degauss_steps else "./dm recipes"


def recipes(
    curvatures: Annotated[
        str,
        typer.Option(
            help="Curvatures [1/m]: -0.02,0,0.02 or first:last:number; empty = -0.05:0.05:11 or, on a mirror that does "
            "not reach these, eleven over its range; 0 with --zernike."
        ),
    ] = "",
    conic: Annotated[float, typer.Option(help="Conic constant of all: 0 = sphere, -1 = paraboloid.")] = 0.0,
    zernike: Annotated[
        list[str] | None,
        typer.Option(help="Added terms [nm]: 'astigmatism cos=200,coma sin=-50'; again for each further shape."),
    ] = None,
    tolerance: Annotated[float, typer.Option(help="Largest coefficient error [nm]; 0 = configured.")] = 0.0,
    max_maps: Annotated[int, typer.Option(min=0, max=100, help="Maps per recipe; 0 = configured.")] = 0,
    show: Annotated[bool, typer.Option("--list", help="Only list the recipes of the calibration in use.")] = False,
    take_over: TakeOverOption = False,
    namespace: NamespaceOption = "",
    json: JsonOption = None,
) -> None:
    """Build recipes on the bench: degauss, go, measure, correct, for each shape; stored with the calibration.

    Needs the running suite (`dm up`) and a calibration. Ctrl-C keeps complete recipes and leaves the mirror at mid
    range.
    """
    from dm_msgs.msg import RecipeBook

    from dm_common.recipes import shape_text, terms_of
    from dm_common.ros import qos

    of_building = {"curvatures": curvatures, "conic": conic, "zernike": zernike, "tolerance": tolerance}
    of_building |= {"max-maps": max_maps, "take-over": take_over}
    if show and (given := next((name for name, value in of_building.items() if value), "")):
        raise typer.BadParameter(f"--list and --{given}: only one of them; --list builds nothing")
    try:
        shapes = [terms_of(text) for text in zernike or ()] or [[]]
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    chosen = curvatures_of(curvatures) if curvatures else [0.0] if zernike else None
    with running_suite(namespace) as client, naming_holder(client):
        client.subscribe("recipes", RecipeBook, qos.LATCHED)
        if not show:
            each = usual_spheres(client.capabilities) if chosen is None else chosen
            wanted = [curvature for curvature in each for _ in shapes]
            terms = [term for _ in each for shape in shapes for term in shape]
            with suppress(Refusal):  # nodes that do not tell their parameters: the run needs no forecast
                console.print(f"expected: {expected_run(client, len(wanted))}")
            result = _build(
                client, wanted, conic, terms, tolerance=tolerance * 1e-9, max_maps=max_maps, take_over=take_over
            )
            console.print(result.message)
            client.wait(lambda: len(client.latest("recipes").recipes) >= result.recipes)
        book = client.latest("recipes")
    for recipe in book.recipes:
        console.print(
            f"{shape_text(recipe)}, conic constant {recipe.conic_constant:g}: largest coefficient error "
            f"{1e9 * recipe.max_zernike:.2f} nm, {1e9 * recipe.rms:.1f} nm rms, {recipe.maps} maps"
        )
    if not book.calibration_id:
        console.print("no calibration is in use")
    elif not book.recipes:
        withheld = "withholds its recipes: maps disagree, or an actuator does not follow"
        console.print(f"calibration {book.calibration_id} {withheld if book.degauss_steps else 'holds no recipes'}")
    write_json(json, {"calibration": book.calibration_id, **_figures(book)})
    next_step(next_of(book), namespace)
