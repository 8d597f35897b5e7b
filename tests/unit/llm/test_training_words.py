"""Which instructions are a run of federated learning, and what becomes of them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConfigError, RefusedError
from appliance.learn import recipe as recipes
from appliance.llm.training_words import RECIPES, TrainingRequest, training_request
from appliance.model import Plan, Subtask, TaskRequest
from appliance.model.learning import Clients
from appliance.tasks.admission import refuse_commands

ROBOTS = ("rover_1", "rover_2", "Drone.3")


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("Train clips on all robots for 20 rounds", TrainingRequest("clips", 20)),
        ("train the words model for twenty rounds on the whole fleet.", TrainingRequest("words", 20)),
        ("Please train sentences with every robot", TrainingRequest("sentences")),
        ("Train clips for 5 federated rounds, please", TrainingRequest("clips", 5)),
        ("train clips on rover_1 and rover_2 for one round", TrainingRequest("clips", 1, ("rover_1", "rover_2"))),
        ("train clips on ROVER_1, drone.3 and rover_1", TrainingRequest("clips", None, ("rover_1", "Drone.3"))),
        ("train clips on rover_1 and rover_9", TrainingRequest("clips", None, ("rover_1",), ("rover_9",))),
    ],
)
def test_a_run_is_told_from_its_words(text: str, wanted: TrainingRequest) -> None:
    """Recipe, rounds and robots, in either order, with the roster's own capitals; names of no robot are told apart."""
    assert training_request(text, ROBOTS) == wanted


@pytest.mark.parametrize(
    "text",
    [
        "train the detector on rover_1", "train clips", "do not train clips on all robots",
        "train clips on all robots?",
        "train clips on all robots for 0 rounds", "train clips on all robots for 20 rounds, then go home",
        "train clips on all robots except rover_1 for 3 rounds", "train clips on all drones and wait for 20 rounds",
        "aggregate the updates", "say \"train clips on all robots\"", "if it rains train clips on all robots", "",
    ],
)  # fmt: skip
def test_whatever_has_another_word_is_an_ordinary_instruction(text: str) -> None:
    """Negations, conditions, questions, further orders and other models are the planner's and its review's."""
    assert training_request(text, ROBOTS) is None


@given(st.text(max_size=300))
def test_no_text_breaks_it(text: str) -> None:
    """Whatever is typed, with or without the beginning of such an order, gives a request or none."""
    for each in (text, f"train clips on {text}", f"train clips for {text} rounds"):
        found = training_request(each, ROBOTS)
        assert found is None or found.recipe in RECIPES


def test_long_texts_take_no_time() -> None:
    """Thousands of names and blanks are no order, and are seen at once."""
    assert training_request("train clips on " + "a and " * 100_000, ROBOTS) is None
    assert training_request("train clips on " + "a, " * 600, ROBOTS) is None


def test_recipes_are_those_of_the_product() -> None:
    """The words for them are the names that `swiftbot learn start` takes."""
    assert recipes.built_in() == tuple(sorted(RECIPES))


def test_handed_in_as_a_task_it_is_refused_with_the_command() -> None:
    """From robots, templates and the command line; a plan of a person's own with these words is none of it."""
    with pytest.raises(RefusedError, match="run of federated learning") as caught:
        refuse_commands(TaskRequest(instruction="Train clips on all robots for 20 rounds"), ROBOTS)
    assert caught.value.remedy == "swiftbot learn start clips --robots all --rounds 20"
    with pytest.raises(RefusedError, match="the fleet has not: rover_9") as caught:
        refuse_commands(TaskRequest(instruction="train clips on rover_9"), ROBOTS)
    assert "--robots ROBOT,..." in caught.value.remedy
    plan = Plan(domain="learning", subtasks=(Subtask(id="s1", skill="train_local"),))
    refuse_commands(TaskRequest(instruction="train clips on all robots", plan=plan), ROBOTS)


def test_a_recipe_is_made_for_robots() -> None:
    """In place of parts of a data set; how many a round waits for stays where there are as many; none is refused."""
    recipe = recipes.load(recipes.find("clips"))
    made = recipes.for_robots(recipe, ("rover_1", "rover_2"), "clips")
    assert (made.names, made.clients.partitions, made.rounds) == (("rover_1", "rover_2"), 0, recipe.rounds)
    few = recipes.for_robots(
        recipes.parse('model = "clips"\n[clients]\npartitions = 8\nper_round = 4', "x"), ("a",), "x"
    )
    assert few.clients == Clients(robots=("a",))
    with pytest.raises(ConfigError, match="clients: there are none"):
        recipes.for_robots(recipe, (), "clips")
