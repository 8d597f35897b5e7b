"""A recogniser of whole instructions: what a plan does not account for has to be derivable as part of an order. Pure.

A token that the plan accounts for is content: a mention of robots (R), a word of a verb phrase (V), a word of a value
(A), a kept prohibition or condition (K). The runs of words between contents are what this grammar is about, each by the
contents on its two sides and by its place in the sentence: an opening and a frame before the order ("hello, could you
please have"), links within it ("to the"), connectives between orders ("and then"), a close ("there, please"). The lists
are closed: a run that is not derivable holds the plan, and its words are named. So a new way to make an order none, or
one for later, needs no word here: it is held because nothing derives it.
"""

import re
from collections.abc import Iterator, Sequence
from functools import lru_cache

from msgspec import Struct

__all__ = ["COURTESIES", "Gap", "derivable", "gaps", "outstanding"]

STRONG = frozenset((".", ";", "!", "?", "\n", "…"))
"""Marks that end a sentence or a part of one."""


class Gap(Struct, frozen=True):
    """A run of words that no content is, with the contents at its sides: START and END are those of the text."""

    left: str
    words: tuple[str, ...]
    right: str
    at: tuple[int, ...] = ()


COURTESIES: set[tuple[str, ...]] = {
    (greeting, mark) for greeting in ("morning", "afternoon", "evening") for mark in ("!", ",")
} | {(greeting, "there") for greeting in ("hi", "hello", "hey")}
"""Runs of words of courtesy: none of their words means anything by itself."""


VOCABULARY: set[tuple[str, ...]] = set()
"""All runs of words that may stand beside what a plan accounts for."""


def _any(text: str, *, courtesy: bool = False) -> str:
    """A pattern of alternatives, one a line or between bars, each of whole words."""
    found = (" ".join(each.split()) for each in re.split(r"[|\n]", text))
    ordered = sorted(filter(None, found), key=len, reverse=True)
    VOCABULARY.update(tuple(each.split()) for each in ordered)
    if courtesy:
        COURTESIES.update(tuple(each.split()) for each in ordered if " " in each)
    return "(?:" + "|".join(re.escape(each) + " " for each in ordered) + ")"


# --- closed lists ---------------------------------------------------------------------------------------------------

_PLEASE = _any("please|pls|plz|kindly|please and thank you|please thank you|please kindly|do please|be a dear and")
_NOW = _any("now|right now|right away|immediately|straight away|at once|asap|pronto|first thing|first|next|now please")
_FRIEND = _any(
    "there|team|all|both|folks|buddy|mate|pal|lads|everyone|my friend|my dear|colleague|colleagues|robot|guys"
)
_THANKS = (
    "(?:"
    + _any(
        """
    thanks|thank you|thank you so much|thank you very much|thx|ta|cheers|thanks a lot|many thanks
    much appreciated|is much appreciated|would be much appreciated|will do|over|would you|will you|could you
    thanks in advance|many thanks in advance|thank you in advance|thank you bye|bye|good night|and good night
    thanks and good night|over and out|out|copy|that's all|that is all|kind regards|best regards|warm regards
    best wishes|with thanks
    would be great|would be nice|would be lovely|if you please|no rush|no hurry|no worries|no problem
    """,
        courtesy=True,
    )
    + _FRIEND
    + "?)"
)
_GREETING = (
    _any(
        """
    hi|hello|hey|yo|good morning|good afternoon|good evening|good day|morning|evening|afternoon|dear|excuse me
    mister|namaste|bonjour|bonsoir|hola|buenos dias|buongiorno|ciao|guten tag|guten morgen|moin|servus|salut|aloha
    ok|okay|right|alright|all right|well|so|um|uh|er|erm|hm|hmm|ah|oh|sure|great|good
    """,
        courtesy=True,
    )
    + "(?:dear )?"
    + _FRIEND
    + "?"
)
_BEFOREHAND = _any(
    """
    no problem at all|no problem|no worries|no rush|no hurry|without exception|as a next step|carefully now
    ok next one|if you please|if i may trouble you|if i may|if you would be so kind|if you don't mind
    if you wouldn't mind|if it's not too much trouble|if it's no trouble|if it is no trouble|if that's ok
    if that's okay|if that's alright|if that is ok|if it pleases you|when you have a second
    when you have a moment|when you have a minute|when you have a sec|when you get a sec|when you get a second
    when you get a moment|when you get a minute
    """,
    courtesy=True,
)
_TO_YOU = _any(
    """
    could you|can you|would you|will you|would you mind|could you please|can you please|would you please
    will you please|would you kindly|could you kindly|i want you to|i need you to|i'd like you to
    i would like you to|we want you to|we need you to|we'd like you to|i'd love you to|you are to|you have to
    you must|you should|you shall|you may|be so kind as to|be so good as to|be good enough to
    be so kind and|be so good and
    would you be so kind as to|would you be so good as to|it'd be great if you|it'd be good if you
    it would be great if you|it would be good if you|it would be nice if you|i'd appreciate it if you
    i would appreciate it if you|we'd appreciate it if you|i'd be grateful if you|how about you
    do me a favour and|do me a favor and|don't forget to|do not forget to|don't hesitate to|do not hesitate to
    let's|let us|go ahead and|mind|would it be possible for you to
    """,
    courtesy=True,
)
_FOR_ME = _any(
    """
    i need|i want|i'd like|i would like|could i have|can i have|may i have|could we have|can we have|we need
    we want|get me|could i get|give me
    """,
    courtesy=True,
)
_WISH = _any(
    """
    i need|i want|i'd like|i would like|i'd love|i would love|we need|we want|we'd like|we would like|we'd need
    i'd need|could|would|could i have|could we have|can i have|can we have|may i have|it's time for
    the next job for|by|with|as for|the next task for|next job for|i'd appreciate it if|i would appreciate it if
    we'd appreciate it if|mind|let's|we would appreciate it if|grateful if|i'd be grateful if
    i would be grateful if|let's get|let's have|let us have
    """,
    courtesy=True,
)
_HAVE = _any("have|let|get|send|make|tell|ask|order|sending|having|getting|take|bring|need|instruct|command")
_BEGIN = _any("now|next|then|and|first|firstly|so")
_ARTICLE = _any("the|a|an|my|our|your|its|his|her|their")
_PREPOSITION = _any(
    """
    to|at|in|on|from|for|of|with|by|near|into|onto|through|via|inside|towards|toward|along|around|over|across
    down|up|off|back|out|past|between|among|against|beside|about|round|straight|next to|in front of|behind|under
    above|outside|as far as|per|using|regarding|=
    """
)
_OBJECT = _any("it|them|him|her|me|us|itself|themselves|yourself|yourselves|himself|herself")
_PLACE = _any("there|here|over there|over here|where it is|where it stands|where they are|where you are")
_IT = _any("it|he|she|they|you|both|that one|everyone|all")
_DONE = _any(
    """
    there|done|ready|arrived|finished|landed|back|airborne|in position|complete|completed|got there|answered|home|here
    down|up|been there|in the air|on site|in place|open|closed|in|finnished|reached it|back there
    """,
    courtesy=True,
)
_WHEN = _any("when|once|as soon as|after|and when|and once|until")
_ARRIVED = (
    f"(?:{_WHEN}(?:{_IT}{_any('is|are|has|have|gets|get|has been|have been')}(?:both |all )?{_DONE}|"
    + _any(
        """
    that's finished|that is finished
    that's done|that is done|it's done|it's there|you're there|you're done|you've arrived|they've arrived|done
    there|finished|he arrives|it arrives|she arrives|they arrive|you arrive|it lands|it finishes|they're there
    they land|they're both there|they are both there|they're all there|all three are there|both are there
    everyone is there|you've found it|you have found it|you found it|it's found|it is found
    """
    )
    + ")(?:there )?|"
    + _any("on arrival|upon arrival|from there|having got there|having arrived|and from there|at the end")
    + ")"
)
_JOIN = (
    "(?:"
    + _any(
        """
    and|then|and then|after that|and after that|afterwards|and afterwards|after which|thereafter|whereupon|next
    finally|lastly|and finally|and also|also|plus|as well as|while|whilst|meanwhile|and meanwhile
    in the meantime|before|after|once|when|and when|at the same time|and at the same time|at the same time :
    as soon as|so|but first|but|followed by|and next|subsequently|in parallel|simultaneously|and simultaneously
    first|firstly|second|secondly|third|thirdly|fourth|fifth|and lastly|last|then finally|and in the end
    in the end|i.e.|then after that|and in the meantime|during that time|until|straight after|right after
    right after that|for that|then on|then back|and on|and once|and so|and while|together with|so that
    """
    )
    + f"|{_ARRIVED})"
)
_FIRST = _any(
    "in parallel|simultaneously|when|once|while|whilst|before|after|as soon as|as|at the same time :|first|firstly|by"
)
_SUBJECT = (
    "(?:"
    + _any(
        """
    it|he|she|they|you|both|each|all|let it|let them|have it|have them|have yourself|let him|let her|have him
    have her|everyone|get it to|get them to|send it|get it|bring it|take it|let both|then it|the other
    the second|the first|the third
    """
    )
    + _any("should|must|shall|will|is to|are to|has to|have to|needs to|need to|to|then|also|both|each|all")
    + f"?{_PLEASE}?)"
)
_MODAL = _any(
    """
    should|must|shall|will|is to|are to|has to|have to|needs to|need to|ought to|to|mind|be so kind as to|start
    begin|go|both|each|all|go and|first|then|now|also|just|next|you|you should|you go|you are to|you must
    you then|it is to|have it|have|let it|have them|can you|could you|would you|will you|could you please
    can you please|would you please|will you please|would you kindly|would you mind|i want you to
    i'd like you to|i need you to|how about you|they|go ahead and|um|uh|be a dear and|be so good as to
    meanwhile|in the meantime|after that|afterwards|would you be so kind as to|at the same time|simultaneously
    proceed to|have a go at|having got there it is to
    """
)
_HAS = _any("has|have|has been|have been|is|are|gets")
_ORDER = _any(
    """
    too|as well|also|together|respectively|in that order|in this order|in order|one after another
    one after the other|one by one|at the same time|simultaneously|in parallel|in turn|afterwards|after that
    side by side|each|locally|on its own|on its own data|on their own data
    """,
    courtesy=True,
)
_CLOSE = (
    f"(?:{_PLACE}|{_ORDER}|{_NOW}|"
    + _any(
        """
    again|with you|for me|for us|with it|of it|for it|from it|of them|for them|on it|in it|when you're ready
    when you are ready|when you like|as you go|to base|at the end|then
    """
    )
    + f"|{_ARRIVED})"
)
_SEP = r"(?:[,:–—-] |- > |= > )"

# --- the grammar ----------------------------------------------------------------------------------------------------

_SMALL = _any("my friend|mate|my dear|buddy|pal|colleague")
_COURTESY = f"(?:{_SEP}*(?:{_PLEASE}|{_THANKS}|{_NOW}|{_SMALL}))*{_SEP}*"
_ASIDE = f"(?:(?:{_GREETING}|{_PLEASE}|{_THANKS}|{_BEFOREHAND}){_SEP}*)*"
_OPENING = f"{_ASIDE}(?:{_BEGIN}{_SEP}*)?(?:{_PLEASE}{_SEP}*)?"
_JUST = _any("to|a|an|the|just|you|go and|both")
_NEEDED = _any("i need you|i want you|be|be back|get back")
_GOING = _any(
    "make their way|make its way|make your way|is wanted|wants to be|should be|is needed|to be|has been|let|let it"
)
_AND = _any("and|then|and then|, and then|while|at the same time|and also|also|and while|first|both")
_ALONG = _any("and|with|to|both|plus|along with|together with|as well as|from|by|followed by|then|and then")
_FRAMES = {
    "R": f"(?:{_TO_YOU}?{_PLEASE}?(?:{_HAVE}|{_WISH}{_HAVE}?)|{_TO_YOU}{_PLEASE}?{_HAVE})?(?:both |the )?",
    "V": f"(?:{_TO_YOU}{_PLEASE}?(?:just |both )?|{_FOR_ME}{_ARTICLE}?|{_JUST})?{_PLEASE}?",
    "A": f"(?:{_FOR_ME}|{_TO_YOU}|{_HAVE}{_OBJECT}?|{_NEEDED})?{_PREPOSITION}{{0,3}}{_ARTICLE}?(?:\\( )?",
    "K": "(?:but |and )?(?:you |do )?",
}
"""What makes what follows an order."""
_STATE = f"(?:{_HAS}(?:both |all )?(?:{_DONE})?{_SEP}*)"
"""Behind "once rover_1": what has been done or reached."""
_SUBORDINATES = frozenset(("when", "once", "after", "as", "until", "till", "before"))
_HAVING = _any("it has|it have|you have|they have|he has|she has|you've|it's|they've|he's|she's")
_SINCE = f"{_any('when|once|after|as soon as|before|until')}{_HAVING}"
_TOLD = _any(
    """
    the number|the numbers|the result|the results|the answer|what it sees|what you see|what you find|what he answers
    what she answers|what they answer|what he says|what she says|about it|about them|that you are done|that it's done
    it has arrived|it is done|it has finished|it is there|you are done|how many there are|there are
    you have arrived
    """,
    courtesy=True,
)
_END = f"(?:{_SEP}*{_CLOSE}){{0,2}}{_COURTESY}(?:{_CLOSE})?{_COURTESY}"
_TAILS = {
    "V": f"{_OBJECT}{{0,2}}(?:{_TOLD})?(?:up |down |back |over )?{_END}",
    "A": _END,
}
_LINKS = {
    "RV": f"{_SEP}*{_PLEASE}?(?:{_BEFOREHAND}{_SEP})?{_MODAL}?{_SEP}?{_PLEASE}?{_MODAL}?{_PLEASE}?",
    "RA": f"{_SEP}*{_PLEASE}?(?:{_BEFOREHAND}{_SEP})?(?:{_GOING})?{_SEP}?{_PREPOSITION}{{0,2}}{_ARTICLE}?(?:[(:] )?",
    "RR": f"{_SEP}?(?:{_ALONG})?",
    "VA": f"{_OBJECT}?{_PLEASE}?(?:there |up |down |back )?(?:carefully )?{_SEP}?"
    f"{_PREPOSITION}{{0,2}}{_OBJECT}?{_PREPOSITION}?{_ARTICLE}?(?:that )?(?:[(:=] )?",
    "VR": f"{_OBJECT}?(?:up |back |there |over )?{_SEP}?(?:{_any('to|by|with|for|from|of|that|among')})?{_ARTICLE}?",
    "VV": f"{_OBJECT}{{0,2}}{_SEP}?(?:{_any('to|and|with|for|for a|by|go and|there|you')})?{_ARTICLE}?",
    "AA": f"{_SEP}?(?:there |the way )?{_PREPOSITION}{{0,2}}{_OBJECT}?{_SEP}?{_ARTICLE}?(?:that )?(?:[(:=;] )?"
    f"(?:are |doing |is )?",
    "AR": f"{_SEP}?{_any('with|by|from|to|and|for|of')}?{_ARTICLE}?",
    "AV": f"{_SEP}?{_any('to|a|for a|and a|the|of|for|by|with|the way to|then send me a')}?",
}
"""What stands within a clause."""


@lru_cache(maxsize=256)
def _pattern(text: str) -> re.Pattern[str]:
    return re.compile(text)


def _fits(pattern: str, words: Sequence[str]) -> bool:
    return _pattern(pattern).fullmatch("".join(f"{each} " for each in words)) is not None


_IDIOMS = re.compile(r"i \. e \. |(?:\. ){2,}|[:;] \) ")
"""Marks that together mean something else."""
_SEQUEL = frozenset(("after", "afterwards", "arrived", "arrives", "lands", "landed"))
"""Words behind a single order that put it after something else."""
_NO_BEGINNING = frozenset((";", ",", ".", "?", "!", ":", "-", "–", "—"))
SMALL = frozenset(word for run in VOCABULARY for word in run)
"""All words that may stand beside what a plan accounts for."""
_LONGEST = 24
"""Words of the longest run that is looked at."""


@lru_cache(maxsize=8192)
def derivable(left: str, words: tuple[str, ...], right: str, *, several: bool = True) -> bool:
    """Return whether the grammar derives a run of words between two contents; `several`: of a plan of several steps."""
    if words[:1] == (")",) and left == "A":
        words = words[1:]
    if words[-1:] == ("@",) and right == "R":
        words = words[:-1]
    flat = _IDIOMS.sub(lambda found: found.group().replace(" ", "") + " ", "".join(f"{each} " for each in words))
    pieces: list[list[str]] = [[]]
    for each in flat.split():
        if each in STRONG:
            if pieces[-1] or len(pieces) == 1:
                pieces.append([])
        else:
            pieces[-1].append(each)
    if left == "START" and words[:1] and words[0] in _NO_BEGINNING:
        return False
    if "should have " in flat or (several and "where you are " in flat):
        return False  # what was not done; what takes the move before it back
    if any(len(each) > _LONGEST for each in pieces) or (
        right == "END" and not several and any(each in _SEQUEL for each in pieces[0])
    ):
        return False
    if len(pieces) == 1:
        return _within(left, pieces[0], right, several)
    first, *between, last = pieces
    return (
        _fits(_OPENING if left == "START" else _TAILS.get(left, _COURTESY), first)
        and all(_fits(_ASIDE, each) for each in between)
        and (_fits(f"{_ASIDE}{_NOW}?", last) if right == "END" else _begins(last, right, several))
    )


def _begins(words: Sequence[str], right: str, several: bool, *, opens: bool = False) -> bool:
    """Whether words are the beginning of a sentence; `opens`: of the text."""
    frame = _FRAMES[right]
    if _fits(f"{_OPENING}{frame}", words):
        return True
    joined = "" if opens else f"|{_SEP}?{_JOIN}{{1,2}}"
    join = f"{_OPENING}(?:{_FIRST}|{_SINCE}{joined})?{_SEP}?(?:{_SUBJECT})?{_SEP}?{_PLEASE}?{frame}"
    return several and _fits(join, words)


def _within(left: str, words: Sequence[str], right: str, several: bool) -> bool:
    """Whether a run without a sentence's end is derivable."""
    if right == "END":
        return left != "START" and _fits(_TAILS.get(left, _COURTESY), words)
    if left == "START":
        return _begins(words, right, several, opens=True)
    if not words:
        return True
    link = _LINKS.get(left + right)
    if link is not None and _fits(link, words):
        return True
    frame, tail = _FRAMES[right], _TAILS.get(left, _COURTESY)
    if right == "K" and _fits(f"{tail}{_SEP}?{frame}", words):
        return True
    if left == "K" and words[:1] in ((",",), ("but",)):
        frame = f"(?:but )?(?:just |do )?{frame}"
    if _fits(f"{_COURTESY}{_PLEASE}?{frame}" if left in "RK" else f"{tail}(?:{_SEP}{frame})?", words):
        return True
    if left == "R" and right == "V":
        join = f"{_COURTESY}{_SEP}?(?:{_AND}|after )?{_SEP}?(?:{_SUBJECT})?{_SEP}?{_PLEASE}?{_MODAL}?{frame}"
        return several and _fits(join, words)
    join = f"{tail}{_SEP}?(?:{_SINCE}|(?:{_JOIN}{_SEP}?){{0,2}}){_SEP}?(?:{_SUBJECT})?{_SEP}?{_PLEASE}?{_MODAL}?{frame}"
    return several and _fits(join, words)


def gaps(labels: Sequence[str]) -> Iterator[Gap]:
    """Yield the runs of words between contents; a label is R, V, A or K for content, else the word."""
    left, run = "START", list[int]()
    for index, label in enumerate((*labels, "END")):
        if label in _CONTENT:
            yield Gap(left, tuple(labels[each] for each in run), label, tuple(run))
            left, run = label, []
        else:
            run.append(index)


_CONTENT = frozenset(("R", "V", "A", "K", "END"))
_PAST = frozenset(
    [
        "went",
        "gone",
        "taken",
        "brought",
        "said",
        "done",
        "held",
        "found",
        "flown",
        "left",
        "got",
        "shot",
        "made",
        "came",
        "drove",
        "flew",
        "took",
        "gave",
    ]
)
_NO_PAST = frozenset(("proceed", "feed", "speed", "need", "head"))
_NO_GERUND = frozenset(("bring", "swing", "ring", "sing", "ping"))
_PERFECT = re.compile(
    r"(?:(?:when|once|after|as|until|till) (?:(?:R |it |you |he |she |they |both |all |and |A )+"
    r"(?:has|have|is|are|has been)|you've|it's|they've|he's|she's) |"
    r"\b(?:grateful|it|glad|happy|great|good|nice) if (?:both |R and |R , )*(?:R |you )|\bbe )$"
)
"""What stands before a verb in the past: what has been done first, or what somebody would like."""
_STATED = frozenset(("is", "are", "'s", "'re"))
_SUBORDINATE = re.compile(
    r"\b(?:when|once|after|as|until|till|before|while|if) (?:R |and |, |both |all |it |they |you )+$"
)
"""What stands before a state that something waits for: "once rover_1 is at dock 2"."""
_GERUND = re.compile(
    r"(?:\b(?:while|whilst|after|before|mind|by|off|start|begin|at|and|then|when) (?:both )?|"
    r"A (?:[,–-] )?|V (?:it )?|a )$"
)
"""What stands before a verb in -ing that is carried out."""


_LISTED = ((), ("and",), (",",))


def moods(labels: Sequence[str], texts: Sequence[str]) -> Iterator[int]:
    """Yield verbs that give no order by their form: past, or in progress."""
    for index, label in enumerate(labels):
        if label != "V" or (index and labels[index - 1] == "V"):
            continue
        text = texts[index]
        if text in ("stay", "remain") and index and labels[index - 1] == "but":
            yield index  # takes the move before it back
        before = "".join(f"{each} " for each in labels[max(0, index - 8) : index])
        if text in _STATED and not _SUBORDINATE.search(before):
            yield index  # "rover_1 is at dock 2" says where it is
        past = text in _PAST or (text.endswith("ed") and text not in _NO_PAST)
        gerund = text.endswith("ing") and text not in _NO_GERUND
        single = index and labels[index - 1] == "R" and re.search(r"\d|^the ", texts[index - 1])
        if single and index > 1 and labels[index - 2] in _SUBORDINATES and not (past or gerund or text.endswith("s")):
            yield index  # "when rover_1 go": a clause that is none
        if (past and not _PERFECT.search(before)) or (gerund and not _GERUND.search(before)):
            yield index


def outstanding(labels: Sequence[str], texts: Sequence[str], *, several: bool = True) -> list[int]:
    """Return the tokens that stand out: of runs that are not derivable, and verbs that give no order."""
    found = set(moods(labels, texts))
    depends = False
    for gap in gaps(labels):
        words = gap.words
        if depends and gap.left == "R" and (state := _pattern(_STATE).match("".join(f"{each} " for each in words))):
            words = words[len(state.group().split()) :]
        if not derivable(gap.left if words == gap.words else "A", words, gap.right, several=several):
            found.update(gap.at)
        both = words[-1:] == ("both",)
        last = words[-2:-1] if both else words[-1:]
        depends = gap.right == "R" and ((last[:1] and last[0] in _SUBORDINATES) or (depends and words in _LISTED))
    return sorted(found)
