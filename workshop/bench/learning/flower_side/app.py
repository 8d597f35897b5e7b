# pyright: basic, reportMissingImports=false, reportMissingModuleSource=false
# Flower and PyTorch are in the environment of `make flower` only.
"""Flower's server and client, which train the product's model by the product's training loop on the same samples.

`SWIFTBOT_FLOWER` names a JSON file with `skills` (folder of the handlers' library), `data` (folder of a .npz for each
client), `model`, `clients`, `rounds`, `seed` and `told` (a file that gets a line of JSON for each round).
"""

import json
import os
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from flwr.app import ArrayRecord, Context, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp
from flwr.serverapp import Grid, ServerApp
from flwr.serverapp.strategy import FedAvg

SETTINGS: dict[str, Any] = json.loads(Path(os.environ["SWIFTBOT_FLOWER"]).read_text(encoding="utf-8"))
sys.path.insert(0, SETTINGS["skills"])
client = ClientApp()
server = ServerApp()


def _tools() -> tuple[Any, Any, Any]:
    """Return what trains; PyTorch is loaded here, so that a process that does not train is without it."""
    from _lib.learning import models, orders, training  # noqa: PLC0415

    return models, orders, training


@client.train()
def train(message: Message, context: Context) -> Message:
    """Train one epoch on the samples of a client."""
    began = time.monotonic()
    models, orders, training = _tools()
    training.set_threads()
    number = int(context.node_config["partition-id"])
    with np.load(Path(SETTINGS["data"]) / f"{number}.npz") as found:
        arrays, targets, classes = found["arrays"], found["targets"], int(found["classes"])
    model = models.read(SETTINGS["model"])
    module = training.build(model, classes)
    base = {name: each.numpy() for name, each in message.content["arrays"].to_torch_state_dict().items()}
    training.put(module, base)
    plan = training.Plan(
        task=model.task, optimiser=orders.optimiser_of(model.optimiser), epochs=1, batch=model.batch,
        run_seed=SETTINGS["seed"], round=int(message.content["config"]["server-round"]), client=str(number),
        stop_at=None, speed=1.0, nominal_batch_s=None,
    )  # fmt: skip
    done = training.train(module, training.Samples(list(arrays), list(targets)), plan)
    metrics = {
        "num-examples": len(arrays), "loss": done.loss, "train_s": done.seconds,
        "whole_s": time.monotonic() - began,
    }  # fmt: skip
    content = RecordDict({"arrays": ArrayRecord(module.state_dict()), "metrics": MetricRecord(metrics)})
    return Message(content=content, reply_to=message)


class Timed(FedAvg):
    """FedAvg that tells how long rounds take: from choosing the clients to the new model."""

    began = 0.0

    def configure_train(self, server_round: int, *args: Any, **kwargs: Any) -> Iterable[Message]:
        """Choose the clients."""
        type(self).began = time.monotonic()
        return super().configure_train(server_round, *args, **kwargs)

    def aggregate_train(self, server_round: int, replies: Iterable[Message]) -> Any:
        """Make the next model."""
        there = list(replies)
        result = super().aggregate_train(server_round, there)
        good = [each for each in there if not each.has_error()]
        line = {
            "round": server_round,
            "took_s": time.monotonic() - self.began,
            "replies": len(good),
            "train_s": [float(each.content["metrics"]["train_s"]) for each in good],
        }
        with Path(SETTINGS["told"]).open("a", encoding="utf-8") as told:
            told.write(json.dumps(line) + "\n")
        return result


@server.main()
def main(grid: Grid, context: Context) -> None:
    """Run the rounds."""
    del context
    models, _, training = _tools()
    with np.load(Path(SETTINGS["data"]) / "0.npz") as found:
        classes = int(found["classes"])
    model = models.read(SETTINGS["model"])
    module = training.build(model, classes)
    training.put(module, models.initial(model.tensors(classes), SETTINGS["seed"]))
    count = int(SETTINGS["clients"])
    strategy = Timed(
        fraction_train=1.0, fraction_evaluate=0.0, min_train_nodes=count, min_available_nodes=count,
        min_evaluate_nodes=0,
    )  # fmt: skip
    strategy.start(grid=grid, initial_arrays=ArrayRecord(module.state_dict()), num_rounds=int(SETTINGS["rounds"]))


if __name__ == "__main__":
    from flwr.simulation import run_simulation

    run_simulation(
        server_app=server,
        client_app=client,
        num_supernodes=int(SETTINGS["clients"]),
        backend_config={"client_resources": {"num_cpus": 1, "num_gpus": 0.0}},
    )
