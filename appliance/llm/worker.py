"""The model's own process: loads an onnxruntime-genai folder and answers prompts under a grammar.

Why a process: the library holds Python's lock while it computes (half a second for a long prompt), and a gateway that
stalls that long loses its leases; and a model that crashes or eats memory must not take the gateway along. Run as
`python -m appliance.llm.worker FOLDER`, frames on stdin and stdout (`frames`). It ends when stdin ends.

What is kept between prompts: the generator with the tokens it has seen. The next prompt rewinds to the longest common
prefix, which is the fixed part with the catalogue, so that only the instruction is computed each time. A generator
belongs to one grammar; the grammar changes when the roster does.
"""

import importlib
import json
import math
import os
import queue
import re
import signal
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import msgspec

from appliance.llm import frames
from appliance.llm.decoder import (
    BrokenOffError,
    Card,
    Question,
    Speaker,
    TooLateError,
    TooLongError,
    Voice,
    Voices,
    read_card,
    read_evidence,
)
from appliance.llm.settings import remedy_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_NEEDED = ("genai_config.json",)
_SPARE = 64
"""Tokens that must be left for an answer."""
_SKILL = re.compile(r'"skill":"([a-z0-9_]*)$')
_ROBOT = re.compile(r'"robot":("[a-z0-9_.-]*)?$')
_AFTER = re.compile(r'"after":\[((?:"s\d+",)*)("s?\d*)?$')
_NEXT = re.compile(r'"after":\[(?:"s\d+",)*"s\d+"$')
_INDEX = re.compile(r'"id":"s(\d+)"')


class WorkerError(Exception):
    """Something that cannot be done, with code and remedy as the gateway's errors have them."""

    def __init__(self, code: str, message: str, remedy: str = "") -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.remedy = remedy


def check_folder(folder: Path) -> None:
    """Refuse a folder that cannot be a model, before the library says it in its own words."""
    remedy = remedy_of(str(folder))
    if not folder.is_dir():
        raise WorkerError("prerequisite", f"there is no model folder {folder}", remedy)
    for name in _NEEDED:
        if not (folder / name).is_file():
            raise WorkerError("prerequisite", f"model folder {folder} has no {name}", remedy)


class _Loaded:
    """A model of the library, with its tokenizer: its own, or that of the planner it belongs to."""

    def __init__(self, folder: Path, threads: int, *, tokenizer: Any = None) -> None:
        check_folder(folder)
        try:
            sizes = json.loads((folder / "genai_config.json").read_text(encoding="utf-8"))["model"]
            self.context = int(sizes["context_length"])
            self.vocabulary = int(sizes.get("vocab_size", 0))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise WorkerError(
                "prerequisite", f"{folder}/genai_config.json is damaged: {error!r}", "copy the model folder again"
            ) from error
        # Untyped, and loading it takes 40 MB that only this process is to pay.
        self.og: Any = importlib.import_module("onnxruntime_genai")
        try:
            config = self.og.Config(str(folder))
            if threads:
                options = {"model": {"decoder": {"session_options": {"intra_op_num_threads": threads}}}}
                config.overlay(json.dumps(options))
            self.model = self.og.Model(config)
            self.tokenizer = tokenizer or self.og.Tokenizer(self.model)
        except Exception as error:
            # The library raises bare RuntimeErrors for whatever is wrong with the files.
            raise WorkerError(
                "prerequisite",
                f"model folder {folder} cannot be loaded: {str(error)[:300]}",
                "copy the folder again; it must be made for onnxruntime-genai",
            ) from error

    def voice(self, card: Card) -> Voice:
        """Return it as one of a planner's models."""
        return Voice(self.og, self.model, self.tokenizer, card.tokens, twice=card.twice, context=self.context)


def _speaker(folder: Path, loaded: _Loaded, threads: int) -> Speaker | None:
    """Return the planner of a folder, with the models beside its own; None where it speaks no plan language."""
    again = "copy the model folder again, readable for the gateway"
    try:
        card = read_card(folder)
        if card is None:
            return None
        voices = [loaded.voice(card)]
        for name in card.beside:
            other = read_card(folder / name)
            if other is None or other.tokens != card.tokens:
                raise WorkerError("prerequisite", f"{folder / name} has not the tokens of {folder}", again)
            voices.append(_Loaded(folder / name, threads, tokenizer=loaded.tokenizer).voice(other))
        return Speaker(Voices(voices), card, evidence=read_evidence(folder))
    except (ValueError, OSError) as error:
        raise WorkerError("prerequisite", str(error), again) from error


class Worker:
    """One loaded model."""

    def __init__(self, folder: Path, *, threads: int = 0, max_tokens: int = 8192) -> None:
        loaded = _Loaded(folder, threads)
        self._og, self._model, self._tokenizer = loaded.og, loaded.model, loaded.tokenizer
        self.speaker = _speaker(folder, loaded, threads)
        """For a model that writes the plan language; others are asked in JSON under a grammar."""
        self._limit = min(max_tokens, loaded.context)
        self._generator: Any = None
        self._key = ""
        self._seen: list[int] = []
        self._pieces: dict[str, list[int]] = {}
        self._vocabulary = loaded.vocabulary

    def say(self, question: dict[str, Any], stop: "Callable[[], bool]" = lambda: False) -> dict[str, Any]:
        """Answer an instruction in the plan language; `question` is a `Question`, the answer a `Said`."""
        if self.speaker is None:
            raise WorkerError("internal", "this model does not speak the plan language")
        try:
            return msgspec.to_builtins(self.speaker.answer(msgspec.convert(question, Question), stop))
        except BrokenOffError as error:
            raise WorkerError("cancelled", str(error)) from error
        except TooLongError as error:
            raise WorkerError("plan", str(error), "split the instruction") from error
        except TooLateError as error:
            raise WorkerError("deadline", str(error), "raise llm.local_deadline_s") from error

    def propose(self, request: dict[str, Any], stop: "Callable[[], bool]" = lambda: False) -> dict[str, Any]:
        """Answer a chat under a grammar.

        Args:
            request: `messages`, `grammar`, `choices` (skill and robot names, for the confidence), `deadline_s`.
            stop: whether nobody waits for the answer any more.

        Returns:
            `text`, `confidence` (0 to 1, of the least sure decision), `tokens`, `reused` prompt tokens, `ms`.
        """
        began = time.monotonic()
        prompt = [int(token) for token in self._tokenizer.encode(self._render(request["messages"]))]
        if len(prompt) + _SPARE > self._limit:
            raise WorkerError(
                "plan",
                f"the prompt has {len(prompt)} tokens: the local model may use {self._limit}",
                "raise llm.local_max_tokens, or use a model with a longer context",
            )
        reused = self._feed(prompt, str(request["grammar"]))
        try:
            text, confidence = self._generate(request.get("choices") or {}, began + float(request["deadline_s"]), stop)
        except BaseException:
            self._generator = None
            raise
        elapsed = 1000 * (time.monotonic() - began)
        return {
            "text": text,
            "confidence": confidence,
            "tokens": len(self._seen) - len(prompt),
            "reused": reused,
            "ms": elapsed,
        }

    def _render(self, messages: "Sequence[dict[str, str]]") -> str:
        try:
            return str(self._tokenizer.apply_chat_template(json.dumps(messages), add_generation_prompt=True))
        except Exception:  # noqa: BLE001 - the library raises bare errors for a model without chat template
            return "".join(f"### {each['role']}\n{each['content']}\n" for each in messages) + "### assistant\n"

    def _feed(self, prompt: list[int], grammar: str) -> int:
        """Compute the prompt, reusing what the last one shares with it; return how many tokens that was."""
        common = 0
        if self._generator is not None and self._key == grammar:
            shared = min(len(prompt) - 1, len(self._seen))
            while common < shared and prompt[common] == self._seen[common]:
                common += 1
        try:
            generator = self._rewound(common) if common else self._fresh(grammar)
            generator.append_tokens(prompt[common:])
        except Exception as error:
            self._generator = None
            raise WorkerError("internal", f"the local model failed on the prompt: {str(error)[:300]}") from error
        self._generator, self._key = generator, grammar
        self._seen = list(prompt)
        return common

    def _rewound(self, tokens: int) -> Any:
        self._generator.rewind_to(tokens)
        return self._generator

    def _fresh(self, grammar: str) -> Any:
        params = self._og.GeneratorParams(self._model)
        params.set_search_options(max_length=self._limit, do_sample=False)
        params.set_guidance("lark_grammar", grammar, False)
        return self._og.Generator(self._model, params)

    def _generate(self, choices: dict[str, Any], deadline: float, stop: "Callable[[], bool]") -> tuple[str, float]:
        stream = self._tokenizer.create_stream()
        text = ""
        sure = 1.0
        while not self._generator.is_done():
            if time.monotonic() > deadline:
                raise WorkerError("deadline", "the local model did not end in time", "raise llm.local_deadline_s")
            if stop():
                raise WorkerError("cancelled", "nobody waits for the answer any more")
            open_choice = self._open(text, choices)
            logits = self._generator.get_logits() if open_choice else None
            self._generator.generate_next_token()
            token = int(self._generator.get_next_tokens()[0])
            self._seen.append(token)
            if logits is not None and (share := self._share(logits.reshape(-1), open_choice, token)) is not None:
                sure = min(sure, share)
            text += str(stream.decode(token))
        return text, sure

    def _open(self, text: str, choices: dict[str, Any]) -> list[str]:
        """Return how the text may go on where it decides something; empty elsewhere."""
        tail = text[-400:]
        if match := _SKILL.search(tail):
            return [
                f'{name}","robot":'[len(match[1]) :] for name in choices.get("skill", ()) if name.startswith(match[1])
            ]
        if match := _ROBOT.search(tail):
            said = match[1] or ""
            quoted = [f'"{name}","params":' for name in choices.get("robot") or ()]
            return [each[len(said) :] for each in quoted if each.startswith(said)]
        index = max((int(found) for found in _INDEX.findall(tail)[-1:]), default=1)
        earlier = [f'"s{number}"' for number in range(1, index)]
        if match := _AFTER.search(tail):
            said = match[2] or ""
            options = [*([] if match[1] or said else ["]"]), *earlier]
            return [each[len(said) :] for each in options if each.startswith(said) and len(each) > len(said)]
        return [",", "]"] if _NEXT.search(tail) else []

    def _share(self, logits: Any, options: list[str], token: int) -> float | None:
        """Return the probability of the token among those that could have stood there; None if it was forced."""
        pieces = self._vocabulary_pieces()
        allowed = {
            each for option in options for end in range(1, len(option) + 1) for each in pieces.get(option[:end], ())
        }
        if token not in allowed or len(allowed) < 2 or len(options) < 2:
            return None
        values = {each: float(logits[each]) for each in allowed}
        top = max(values.values())
        total = sum(math.exp(value - top) for value in values.values())
        share = math.exp(values[token] - top) / total
        return share if math.isfinite(share) else 0.0

    def _vocabulary_pieces(self) -> dict[str, list[int]]:
        """Return text -> tokens of it, for the plain ones; made when first needed."""
        if not self._pieces:
            for token in range(self._vocabulary):
                try:
                    piece = str(self._tokenizer.decode([token]))
                except Exception:  # noqa: BLE001, S112 - ids without text: the library raises bare errors
                    continue
                if piece and piece.isascii():
                    self._pieces.setdefault(piece, []).append(token)
        return self._pieces


def serve(folder: Path, requests: BinaryIO, replies: BinaryIO, *, threads: int, max_tokens: int) -> int:
    """Load the model and answer until the requests end; return the exit status."""
    began = time.monotonic()
    try:
        slot = Worker(folder, threads=threads, max_tokens=max_tokens)
    except WorkerError as error:
        frames.write(replies, {"error": {"code": error.code, "message": error.message, "remedy": error.remedy}})
        return 5
    speaks = slot.speaker is not None
    frames.write(replies, {"ready": True, "speaks": speaks, "ms": 1000 * (time.monotonic() - began)})
    inbox = Inbox(requests)
    while (request := inbox.next()) is not None:
        number = request.get("id")
        reply: dict[str, Any] = {"id": number}

        def stop(number: object = number) -> bool:
            return inbox.given_up(number)

        try:
            if stop():
                raise WorkerError("cancelled", "nobody waits for the answer any more")  # noqa: TRY301 - as the others
            reply |= slot.say(request["question"], stop) if "question" in request else slot.propose(request, stop)
        except WorkerError as error:
            reply["error"] = {"code": error.code, "message": error.message, "remedy": error.remedy}
        except Exception as error:  # noqa: BLE001 - supervision boundary: named to the gateway, the slot lives on
            reply["error"] = {"code": "internal", "message": f"the local model failed: {error!r}"[:400], "remedy": ""}
        inbox.forget(number)
        frames.write(replies, reply)
    return 0


class Inbox:
    """What the gateway asks, read by a thread of its own so that a request can be given up while it is worked on."""

    def __init__(self, requests: BinaryIO) -> None:
        self._requests = requests
        self._asked: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._given_up: set[int] = set()
        self._ended = False
        threading.Thread(target=self._read, name="requests", daemon=True).start()

    def next(self) -> dict[str, Any] | None:
        """Wait for a request; None when there will be none."""
        return self._asked.get()

    def given_up(self, number: object) -> bool:
        """Whether nobody waits for the answer to a request any more."""
        return self._ended or number in self._given_up

    def forget(self, number: object) -> None:
        """Note that a request was answered; numbers only grow."""
        if isinstance(number, int):
            self._given_up = {each for each in self._given_up if each > number}

    def _read(self) -> None:
        while True:
            try:
                frame = frames.read(self._requests)
            except (OSError, ValueError):
                frame = None
            if frame is None:
                self._ended = True
                self._asked.put(None)
                return
            if "cancel" in frame:
                self._given_up = {*self._given_up, int(frame["cancel"])}
            else:
                self._asked.put(frame)


def main() -> int:
    """Entry of the process: `slot.py FOLDER [THREADS [MAX_TOKENS]]`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the gateway ends it, not the terminal
    # Libraries print where they like; the frames keep a descriptor of their own.
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    arguments = sys.argv[1:]
    threads = int(arguments[1]) if len(arguments) > 1 else 0
    max_tokens = int(arguments[2]) if len(arguments) > 2 else 8192
    try:
        return serve(Path(arguments[0]), sys.stdin.buffer, replies, threads=threads, max_tokens=max_tokens)
    except BrokenPipeError:
        return 0


if __name__ == "__main__":
    sys.exit(main())
