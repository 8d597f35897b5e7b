"""The words between clauses, and an instruction as sentences: what is done to the text before it is read.

Quoted texts are taken out first, so that no comma in a message looks like the end of an order.
"""

import re

from appliance.llm.language.plurals import singular
from appliance.llm.rules import lexicon as lx
from appliance.model import Subtask

QUOTE = re.compile(
    r"[\"\u201c]([^\"\u201c\u201d]{1,400})[\"\u201d]|(?<![\w])['\u2018]([^'\u2018\u2019]{1,400})['\u2019](?!\w)"
)
LEAD_ALL = re.compile(
    (
        r"(?:and )?(?:then|after that|after this|afterwards|afterward|thereafter|next|finally|"
        r"lastly|subsequently|in the end|"
        r"(?:once|when|as soon as) (?:(?:you are|you're|that is|that's|all(?: of (?:that|this|"
        r"them))? (?:is|are)|everything is|it is|it's|this is) )?(?:all )?(?:done|finished|complete|"
        r"ready))\b[,:]?\s*"
    ),
    re.IGNORECASE,
)
LEAD_BESIDE = re.compile(
    (
        r"(?:and )?(?:meanwhile|in the meantime|in the meanwhile|at the same time|simultaneously|"
        r"in parallel|concurrently)\b[,:]?\s*"
    ),
    re.IGNORECASE,
)
LEAD_FIRST = re.compile(r"(?:first|firstly|first of all|to begin with|to start with)\b[,:]?\s*", re.IGNORECASE)
PREFIX = re.compile(
    r"(?P<word>while|whilst|as soon as|as|before|(?:only )?(?:after|once|when|whenever|if)|in case)\s+(?P<rest>.+)",
    re.IGNORECASE | re.DOTALL,
)
BETWEEN = re.compile(
    r"(?P<then>[,;]?\s+(?:and |but )?(?:then|after that|afterwards|after which|thereafter|"
    r"next|finally|lastly|followed by)\b,?\s+)"
    r"|(?P<beside>[,;]?\s+(?:and\b|but\b|all\b)?,?\s*(?:while|whilst|meanwhile|in the meantime|"
    r"at the same time as|at the same time|simultaneously|in parallel|as (?=(?:you|it|he|she|"
    r"they)\b))\b,?\s+(?:also )?)"
    r"|(?P<before>,?\s+(?:but )?before\s+)"
    r"|(?P<after>,?\s+(?:but )?(?:only )?after\s+|,?\s+(?:- )?but first,?\s+)"
    r"|(?P<when>,?\s+(?:and\b,?\s*|but\b,?\s*)?(?:only )?(?:as soon as|once|when|if)\s+)"
    r"|(?P<list>\s*,\s*(?:and\s+|but\s+)?(?:also\s+)?|\s+and\s+(?:also\s+)?|\s+-\s+|\s*:\s+)",
    re.IGNORECASE,
)
DONE = re.compile(
    r"(?P<who>.+?)(?:'s|'re| is| are| has| have| gets?| get| was| were)?(?: all| both)? (?:been )?"
    r"(?:done|finished|finnished|complete|completed|arrives?|gets? there|there|ready|through|"
    r"arrived|answered|replied|docked|airborne|landed|in position|in place|back|home|in|over|"
    r"up|"
    r"returned|it|at .+|taken off|loaded|charged|the .+ there)(?: (?:there|both|it|this|that|up))?",
    re.IGNORECASE,
)
HERE = re.compile(r"(?:there|done|finished|ready|complete|arrived|in position|back|airborne)", re.IGNORECASE)
FILE = re.compile(
    r"(?:(?:take|use|with|for|from) )?(?P<file>[\w-]+\.[A-Za-z][A-Za-z0-9]{1,4})\s*[:,]\s*(?P<rest>.+)",
    re.IGNORECASE | re.DOTALL,
)
HEADING = re.compile(r"(?P<head>[^:,]{3,80}):\s*(?P<rest>.*)", re.DOTALL)
REWRITES = tuple(
    (re.compile(pattern, re.IGNORECASE), replacement)
    for pattern, replacement in (
        (r",? in (?:that|this) order\b", ""),
        (
            (
                r",?\s*(?:\band,? )?\bwhile (?:driving|flying|walking|moving|going|doing (?:so|that|this)"
                r"),?\s+(?=\w+ )(?!to\b|over\b)"
            ),
            " and at the same time ",
        ),
        (r"\bonly (once|when|after) ([^,.;]+?) (?:may|can|should|will|shall|does) ", r"\1 \2, "),
        (r"\bwhat does ([^,.;?]+?) (?:say|read|show)\b", r"read \1"),
        (r"(?:^|(?<=[.!?] ))((?:the |our )?[\w -]{3,40}?) (?:gets|receives) an? report\b", r"send a report to \1"),
        (
            (
                r"\b(?:i|we) (?:need|want|would like) ((?:the |this |that |a )[^,.;]+?) ((?:transcrib|"
                r"clean|inspect|photograph|film|record|scann|mapp|measur|evaluat|aggregat|check)ed)\b"
            ),
            r"\2 \1",
        ),
    )
)
"""Ways of saying it that are another way of saying it: question, inversion, what somebody needs."""
TRAILING = re.compile(r",\s*(?P<name>[A-Za-z][\w-]*(?: (?:\d+|[A-Z]))?)(?=\s*(?:$|,\s))")


def sentences(text: str, quotes: list[str], names: str) -> list[str]:
    r"""Split an instruction into sentences, lists into one sentence each.

    Args:
        text: the instruction.
        quotes: receives the quoted texts; `\x00n\x00` stands for the n-th in what is returned.
        names: regular expression of names that are surely robots.
    """
    text = text.replace("\x00", " ").replace("\u2013", "-").replace("\u2014", " - ").replace("\u2019", "'")

    def keep(match: re.Match[str]) -> str:
        said = match[1] or match[2]
        quotes.append(said.strip())
        ends = said.rstrip().endswith((".", "?", "!"))
        follows = re.match(r"\s+[A-Z]", text[match.end() :])
        return f"\x00{len(quotes) - 1}\x00" + (". " if ends and follows else "")

    text = QUOTE.sub(keep, text)
    text = re.sub(r"[A-Za-z]+", lambda match: lx.spell(match[0]), text)
    text = re.sub(r"(?:^|(?<=[:\n]))\s*(?:[-*\u2022]) +", "\n", text)
    for pattern, replacement in REWRITES:
        text = pattern.sub(replacement, text)
    text = re.sub(rf"({names}), who (?:then |will |shall )?", r"\1, then \1 ", text)
    marks = re.findall(r"(?:(?<=\s)|^)\(?\d{1,2}[.)]\s", text)
    if len(marks) > 1:
        text = re.sub(r"\s*(?:(?<=\s)|^)\(?(\d{1,2})[.)]\s+", lambda match: " " if match[1] == "1" else ", then ", text)
        text = re.sub(r"[.;]\s*, then ", ", then ", text)
    text = re.sub(r"\b(Dr|Mr|Mrs|Ms|St|No|approx)\.", r"\1", text)
    text = re.sub(r"(?:each|all|both|every one) of (?:the )?(?=\w+s? (?:\d+|[A-Z])\b)", "", text)
    text = re.sub(r"\b([A-Za-z]+)s ((?:(?:\d+|[A-Z]),? )+and (?:\d+|[A-Z]))\b", spread, text)
    parts = re.split(r"(?<=[\w\x00)\]])[.!?;]+(?=\s|$)|\n+|^\. |\s\. ", text)
    return [part.strip() for part in parts if part and part.strip(" .,;:!?")]


def first_chunk(text: str) -> str:
    """Return the text up to its first connective, or a little more where that is no clause yet."""
    match = BETWEEN.search(text, 1)
    return text[: match.start()] if match else text


def clean(text: str) -> str:
    """Strip punctuation and space from both ends."""
    return text.strip(" ,.;:!?-\n\t")


def spread(match: re.Match[str]) -> str:
    """Write "goals 1, 2 and 3" as "goal 1, goal 2 and goal 3"."""
    head = match[1]
    items = re.findall(r"\d+|\b[A-Z]\b", match[2])
    named = [f"{singular(head + 's')} {item}" for item in items]
    return ", ".join(named[:-1]) + " and " + named[-1]


def renamed(subtask: Subtask, old: str, new: str) -> Subtask:
    """Return a subtask with one robot label in place of another."""
    params = dict(subtask.params)
    if "robots" in params:
        params["robots"] = [new if name == old else name for name in params["robots"]]
    robot = new if subtask.robot == old else subtask.robot
    return Subtask(id=subtask.id, skill=subtask.skill, robot=robot, params=params, after=subtask.after)
