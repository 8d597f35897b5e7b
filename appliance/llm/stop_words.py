"""Stop words: which texts are a soft stop and not a task. Pure, linear in the length of the text.

A stop is a sentence whose verb is a stop word of a supported language and whose object is nothing, robots, or
everything; every other word has to be courtesy. A comma that follows such a clause ends it too ("stop, you hit the
wall"). It reaches no planner: typed by a person it is carried out at once, from a robot or a template it is refused
with the command. Text in quotation marks is spoken, and stops nothing.
"""

import difflib
import functools
import re
import unicodedata
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from enum import Enum, unique

import msgspec
from msgspec import Struct


class StopRequest(Struct, frozen=True):
    """A soft stop asked for in words."""

    robots: tuple[str, ...] = ()
    """The robots named; empty together with `unknown`: all."""
    unknown: tuple[str, ...] = ()
    """Names that no robot of the roster has."""


def stop_request(text: str, robots: Sequence[str] = ()) -> StopRequest | None:
    """Return the stop that a text asks for; None for any other text. It never raises.

    Args:
        text: as it was typed.
        robots: the roster's names.
    """
    if (wrapped := _in_json(text, robots)) is not None:
        return wrapped
    sentences = list(_sentences(_unquoted(_plain(text))))
    if not any(_has_stop(each.tokens) for each in sentences):
        return None
    roster = _roster(tuple(robots))
    budget = _Budget()
    found: list[_Heard] = []
    follows = False
    for each in sentences:
        if (heard := _sentence(each, roster, budget)) is None and follows:
            # "stop rover_1; rover_2"
            heard = _clause(each.tokens, roster, budget, first=False, names=True)
        if heard is not None:
            found.append(heard)
        follows = heard is not None and not heard.fleet
    if not found:
        return None
    if any(each.fleet for each in found):
        return StopRequest()
    return StopRequest(
        tuple(dict.fromkeys(robot for each in found for robot in each.robots)),
        tuple(dict.fromkeys(name for each in found for name in each.unknown)),
    )


def _in_json(text: str, robots: Sequence[str]) -> StopRequest | None:
    """Return the stop that a flat JSON object gives as its command: {"cmd": "stop", "robots": "all"}."""
    if not text.lstrip().startswith("{") or len(text) > _MOST_JSON:
        return None
    try:
        found = msgspec.json.decode(text, type=dict[str, str | list[str] | int | float | bool | None])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
    command = next((each for name, each in found.items() if name.casefold() in _COMMAND and isinstance(each, str)), "")
    if not command or (stop := stop_request(command, robots)) is None or command.lstrip().startswith("{"):
        return None
    named: list[str] = []
    for value in found.values():
        values: list[str] = [value] if isinstance(value, str) else value if isinstance(value, list) else []
        named += [name for name in values if name in robots]
    return StopRequest(tuple(dict.fromkeys(named))) if named and not stop.robots else stop


_MOST_JSON = 4096
"""Characters of a command written as JSON."""
_COMMAND = frozenset(("cmd", "command", "action", "op", "verb", "instruction"))


def mentions_stop(text: str) -> bool:
    """Return whether a text has a stop word at all: only then the roster matters to `stop_request`."""
    if text.lstrip().startswith("{") and "stop" in text.casefold():
        return True
    return any(_has_stop(each.tokens) for each in _sentences(_unquoted(_plain(text))))


# --- characters -------------------------------------------------------------------------------------------------

_LOOKALIKES = str.maketrans(
    "аеорсухіјѕһԁԛԝтмнквαορτικνυχεημζβγɑꜱᴛᴏᴘʜᴀʟᴇıłđø",
    "aeopcyxijshdqwtmhkbaoptikvuxehmzbyastophaleildo",
)
"""Letters of other scripts that look like Latin ones, in lower case."""
_SIGNS = str.maketrans(
    {
        **dict.fromkeys("’‘‛′´`ʼ＇", "'"),
        **dict.fromkeys("\u115f\u1160\u3164\uffa0\u2800", None),
        **dict.fromkeys("🛑⏹", " stop "),
        **dict.fromkeys("&+", " and "),
        **dict.fromkeys("\r\v\f\u0085\u2028\u2029", "\n"),
        "…": ". ",
        "。": ". ",
        "§": " ",
    }
)


def _plain(text: str) -> str:
    """Lower case without accents, invisible characters, and look-alike letters of other scripts."""
    text = unicodedata.normalize("NFKC", text.translate(_SIGNS)).translate(_SIGNS).casefold()
    text = "".join(
        each for each in unicodedata.normalize("NFKD", text) if unicodedata.category(each) not in ("Mn", "Cf")
    )
    return re.sub(r"(?<=[a-z])0(?=[a-z])", "o", text.casefold().translate(_LOOKALIKES))


_CLOSERS = {'"': '"', "“": "”“", "”": "”", "„": "“”", "«": "»", "»": "«", "‹": "›", "「": "」", "『": "』"}


def _unquoted(text: str) -> str:
    """Put § for what stands in quotation marks."""
    closing = [each.start() for each in re.finditer(r"(?<=\S)'(?![^\W_])", text)]
    following: dict[str, int] = {}

    def find(mark: str, start: int) -> int:
        if following.get(mark, -1) < start:
            at = text.find(mark, start)
            following[mark] = at if at >= 0 else len(text)
        return following[mark]

    parts: list[str] = []
    done = 0
    for opening in re.finditer(r"[\"“”„«»‹「『]|(?<![^\W_])'(?=\S)", text):
        at = opening.start()
        if at < done:
            continue
        if opening.group() == "'":
            index = bisect_left(closing, at + 2)
            end = closing[index] if index < len(closing) else len(text)
        else:
            end = min(find(mark, at + 1) for mark in _CLOSERS[opening.group()])
        if end < len(text):
            parts += [text[done:at], " § "]
            done = end + 1
    parts.append(text[done:])
    return "".join(parts)


class _Sentence(Struct, frozen=True):
    tokens: list[str]
    """Runs of letters, numbers, and "," for marks that end a clause."""
    first: bool
    mark: str
    """The marks that end it."""


_TOKEN = re.compile(r"[^\W\d_]+(?:'[^\W\d_]+)*|\d+|[,:()–—§]|(?<=\s)-(?=\s)")
_END = re.compile(r"(?:[!?;\n]|\.(?=\s|$|[!?.\"')])|(?<=\d)\.(?=[^\W\d_])|(?<=[^\W\d_]{2})\.(?=[^\W\d_]{2}))+\s*")


def _sentences(text: str) -> Iterator[_Sentence]:
    start, first = 0, True
    for end, after, mark in [
        *((m.start(), m.end(), m.group()) for m in _END.finditer(text)),
        (len(text), len(text), ""),
    ]:
        tokens = ["," if each in ":()–—-" else each for each in _TOKEN.findall(text[start:end])]
        if any(each != "," for each in tokens):
            yield _Sentence(tokens, first, mark)
            first = False
        start = after


# --- words ------------------------------------------------------------------------------------------------------


@unique
class _Kind(Enum):
    STOP = "stop"
    COURTESY = "courtesy"
    ALL = "all"
    """Robots of any kind: "everything", "the fleet"."""
    EACH = "each"
    """"all", "both": means the robots of the kind that follows, or all of them."""
    ARTICLE = "article"
    """Belongs to the robots that follow: "the stop" has none."""
    NO = "no"
    """An interjection before a comma, a negation otherwise."""
    MUST = "must"
    """In a question it asks whether, and orders nothing."""
    NEXT = "next"
    """"then stop": a step of a task, unless nothing precedes it."""
    EXCEPT = "except"


_WORDS: dict[_Kind, str] = {
    _Kind.STOP: """
        stop|halt|freeze|abort|cease|estop|e stop|stop it|stop that|stop this|stop at once|stop moving|stop driving|
        stop flying|stop everything you are doing|stop what you are doing|stop what you're doing|stop whatever you are
        doing|stop all motion|stop all movement|cease all movement|cease movement|cease operations|cease all operations|
        emergency stop|emergency halt|emergency stopp|full stop|hard stop|soft stop|all stop|panic stop|crash stop|
        stop right there|halt right there|freeze right there|stop where you are|halt where you are|freeze where you are|
        stop where it is|stop where they are|stand still|hold still|hold everything|hold it|
        stay where you are|stay right where you are|remain where you are|don't move|dont move|do not move|
        nobody move|nobody moves|no one move|abort mission|abort the mission|abort everything|abort all|
        stop dead|dead stop|come to a stop|come to a halt|come to a standstill|grind to a halt|
        s t o p|sotp|stpo|tsop|sstop|stahp|
        alto|alto ahi|alto ya|para|pare|paren|parad|parate|paraos|parense|parese|deten|detente|detengase|detenganse|
        detengan|deteneos|detened|detener|detenerse|parar|parada de emergencia|paro de emergencia|quieto|quietos|
        quieta|quietas|no te muevas|no se mueva|no se muevan|
        parem|parar tudo|pare ja|detenha-se|detenha se|detenham se|parada de emergencia|nao se mexa|nao se mexam|
        arrete|arretez|arreter|arrete toi|arretez vous|arretons|arret|arret d'urgence|stoppe|stoppez|halte|halte la|
        ne bouge pas|ne bougez pas|ne bouge plus|ne bougez plus|
        stopp|stoppen|stoppt|stoppen sie|anhalten|halt an|halte an|haltet an|halten sie an|stehen bleiben|stehenbleiben|
        bleib stehen|bleibt stehen|bleiben sie stehen|nothalt|not halt|notaus|not aus|notstopp|not stopp|
        nicht bewegen|keine bewegung|
        fermati|ferma|fermo|ferma ti|fermi|ferme|fermate|fermatevi|fermare|fermarsi|alt|arresto|arresto di emergenza|
        stai fermo|state fermi|non muoverti|non muovetevi|
        noodstop|stilstaan|sta stil|blijf staan|niet bewegen|
        stoj|stojcie|zatrzymaj|zatrzymaj sie|zatrzymac|zatrzymac sie|zatrzymajcie|zatrzymajcie sie|stac|
        nie ruszaj sie|zatrzymanie awaryjne|
        стоп|стой|стойте|остановись|остановитесь|стоять|стій|зупинись|зупиніться|спри|спрете|
        στοπ|σταμάτα|σταματήστε|σταμάτησε|
        dur|durun|stanna|stans|seis|pysähdy|állj|zastav|zastavte|opreste|opriti|opreste te|berhenti|dung lai|
        停|停止|停下|停下来|停下來|站住|停车|停車|緊急停止|紧急停止|止まれ|止まって|とまれ|とまって|ストップ|정지|멈춰|멈춰라|서라|
        ruko|ruk jao|ruk ja|ruk jaao|ruk jaiye|रुको|रुक जाओ|रुक जा|रुकिए|थांब|थांबा|
        قف|توقف|توقفي|توقفوا|עצור|עצרו|หยุด""",
    _Kind.COURTESY: """
        please|pls|plz|plse|kindly|now|abhi|अभी|
        right now|right away|immediately|instantly|at once|asap|quick|quickly|fast|
        bloody|damned|freaking|goddamn|stupid|
        just|hey|hi|hello|ok|okay|oh|ah|oi|whoa|god|my god|omg|damn|damn it|dammit|shit|fuck|fucking|crap|argh|help|
        emergency|danger|careful|watch out|look out|attention|warning|urgent|i said|i say|i repeat|repeat|thanks|
        thank you|sir|for now|for god's sake|for heaven's sake|for fuck's sake|this instant|this second|this minute|
        this very moment|straight away|without delay|as soon as possible|all right|alright|enough|do|hold|
        hold position|hold on|wait|wait there|stay|stay put|stay still|stay there|and stay there|you|u|yourself|
        yourselves|it|them|him|her|to|make|get|tell|order|command|let|have|i want you to|i want|we want|can you|
        could you|would you|will you|can u|can you please|can we|can everyone|can everybody|would everyone|
        could everyone|all stations|attention all stations|over|over and out|roger|for gods sake|for god sakes|
        for goodness sake|for pity's sake|for pitys sake|sorry|so sorry|i am sorry|i'm sorry|excuse me|pardon me|
        i am terribly sorry|i'm terribly sorry|sorry to interrupt|i am terribly sorry to interrupt|
        i'm so sorry to interrupt|i am sorry to interrupt|i'm sorry to interrupt|be so kind as to|
        would you be so kind as to|but would you be so kind as to|but could you please|but please|
        if you would be so kind|this very instant|this very second|this very minute|
        i need you to|i order you to|guys|folks|people|mate|buddy|immediate|
        por favor|porfavor|ya|ahora|ahora mismo|ya mismo|inmediatamente|de inmediato|enseguida|rapido|gracias|oye|
        oiga|eh|usted|ustedes|socorro|
        agora|agora mesmo|imediatamente|ja|obrigado|obrigada|voce|voces|
        s'il te plait|s'il vous plait|svp|stp|maintenant|tout de suite|immediatement|merci|vite|aussitot|vous|toi|
        bitte|sofort|jetzt|sofort jetzt|auf der stelle|danke|sie|du|ihr|augenblicklich|unverzuglich|mal|doch|
        per favore|subito|adesso|immediatamente|ora|grazie|ti prego|prego|voi|
        alsjeblieft|alstublieft|aub|nu|meteen|onmiddellijk|direct|dank je|jij|jullie|
        prosze|natychmiast|teraz|juz|dziekuje|szybko|wy|ty|sie""",
    _Kind.ALL: """
        everything|everybody|everyone|anything|robots|robot|the robot|fleet|vehicles|vehicle|machines|machine|units|
        unit|bots|bot|whole fleet|entire fleet|everything else|everyone else|todo el mundo|flota|roboter|flotte|
        fahrzeuge|fahrzeug|vehiculos|vehiculo|maquinas|veiculos|veiculo|frota|robos|robo|vehicules|vehicule|robotten|
        voertuigen|voertuig|vloot|robotow|roboty|robota|pojazdy|pojazd|flotta|veicoli|veicolo|macchine|
        toute la flotte|alles|tout|tudo|tutto|wszystko|todo|tout le monde|iedereen|wszyscy|wszystkich|wszystkie""",
    _Kind.EACH: """
        all|all of|all of you|you all|all the|both|both of|both of you|every|each|any|todos|todas|ambos|tous|toutes|
        tous les|les deux|alle|beide|jeder|jede|alle beide|alle zwei|os dois|as duas|los dos|las dos|tutti e due|
        tutte e due|tutti|tutte|entrambi|allemaal|obie|oba|other|others|whole|entire""",
    _Kind.ARTICLE: """
        the|a|an|these|those|my|our|your|el|la|los|las|le|les|l|die|der|das|den|dem|il|lo|gli|de|het|os|as|un|una|
        une|ein|eine|einen|al|a la|a los""",
    _Kind.NO: "no|nao|non|nein|nee|nie|nope|nah|not",
    _Kind.MUST: """
        must|should|has to|have to|needs to|need to|ought to|shall|better|had better|must all|debe|deben|soll|sollen|
        muss|doit|doivent|deve|devono|moet|moeten|musi""",
    _Kind.NEXT: """
        then|and then|finally|afterwards|after that|eventually|luego|despues|entonces|depois|puis|ensuite|dann|
        danach|poi|dopo|dan|daarna|potem|stop there|stop here|halt there|halt here|freeze there|freeze here""",
    _Kind.EXCEPT: "except|but|except for|but not|other than|apart from|excepto|menos|sauf|ausser|tranne|behalve|oprocz",
}
_AND = frozenset(
    ("and", "or", "y", "e", "et", "und", "en", "i", "oraz", "plus", "as well as", "also", "too", "of", "o")
)
_BEFORE_NAMES = frozenset(("no", "nee", "nein", "nope", "nah"))
"""Interjections before a stop word without a comma: "no stop"."""
_STOPS_HERE = frozenset(("stop", "halt", "freeze"))
"""First words of "stop there", which is a step of a task unless nothing precedes it."""
_IBERIAN = frozenset(
    ("para", "pare", "paren", "parad", "parar", "parem", "pares", "detente", "detengase", "detengan", "deteneos")
)
"""Behind "no" these are negated: "no pare"."""
_ASKING = frozenset(
    ("do", "does", "did", "have", "has", "is", "are", "was", "were", "shall", "need", "may", "might", "to", "get")
)
"""First words of a question that asks for no stop."""
_CONDITIONS = frozenset(
    re.findall(
        r"\w+",
        "then when whenever if after before once unless until till at and or in on near by for as while only "
        "dann wenn falls luego cuando si despues puis quand poi quando se dan als wanneer potem gdy kiedy jesli",
    )
)
"""A clause that begins so goes with the stop before it: "stop, when you are at dock 1"."""
_CONDITIONAL = frozenset(
    ("if", "when", "whenever", "once", "unless", "until", "till", "after", "before", "while", "wenn", "falls", "sobald")
) | frozenset(("si", "cuando", "quand", "quando", "se", "als", "wanneer", "gdy", "jesli", "jezeli", "kiedy"))
"""Words of a sentence whose last clause is no stop of now: "if you see a person, stop!"."""
_GENERIC = frozenset(
    re.findall(
        r"\w+",
        "robot robots vehicle vehicles machine machines unit units bot bots roboter fahrzeug fahrzeuge vehiculo "
        "vehiculos veiculo veiculos robo robos vehicule vehicules voertuig voertuigen robota roboty "
        "robotow pojazd pojazdy",
    )
)
"""Nouns that stand beside a name as well: "robot rover_1"."""
_NUMBER = frozenset(("number", "nr", "nummer", "numero", "num"))
_KINDS = {
    **{each: each for each in ("drone", "rover", "uav", "ugv", "quadcopter", "copter", "robot", "unit", "vehicle")},
    **dict.fromkeys(("drones", "drohne", "drohnen", "dron", "drony", "drona", "droni", "dronow"), "drone"),
    **{f"{each}s": each for each in ("rover", "uav", "ugv", "quadcopter", "copter", "robot", "unit", "vehicle")},
}
_NUMBERS = {
    each: str(number)
    for number, each in enumerate(("one", "two", "three", "four", "five", "six", "seven", "eight", "nine"), 1)
}


def _vocabulary() -> dict[tuple[str, ...], _Kind]:
    found: dict[tuple[str, ...], _Kind] = {}
    for kind, text in _WORDS.items():
        for phrase in text.split("|"):
            words = tuple(re.findall(r"[^\W\d_]+(?:'[^\W\d_]+)*", _plain(phrase)))
            if words:
                found.setdefault(words, kind)
    return found


def _squashed(word: str) -> str:
    return re.sub(r"(.)\1+", r"\1", word)


_VOCABULARY = _vocabulary()
_LONGEST: dict[str, int] = {}
for _phrase in _VOCABULARY:
    _LONGEST[_phrase[0]] = max(len(_phrase), _LONGEST.get(_phrase[0], 0))
_STRETCHED = {_squashed(words[0]): words[0] for words in reversed(_VOCABULARY) if len(words) == 1}
"""Words by their letters without repetition: "STOOOP"."""
_RUN = re.compile(r"(.)\1\1")


def _known(tokens: Sequence[str], at: int) -> tuple[_Kind | None, int]:
    """Return what the longest known phrase at a place is, and its length in tokens."""
    for length in range(min(_LONGEST.get(tokens[at], 0), len(tokens) - at), 0, -1):
        if (kind := _VOCABULARY.get(tuple(tokens[at : at + length]))) is not None:
            return kind, length
    if _RUN.search(tokens[at]) and (word := _STRETCHED.get(_squashed(tokens[at]))) is not None:
        return _VOCABULARY[word,], 1
    return None, 1


def _has_stop(tokens: Sequence[str]) -> bool:
    return any(
        kind is _Kind.STOP or (kind is _Kind.NEXT and tokens[at] in _STOPS_HERE)
        for at in range(len(tokens))
        for kind, _ in [_known(tokens, at)]
    )


# --- robots -----------------------------------------------------------------------------------------------------

MAX_GUESSES = 8
"""Words that are compared with the names of all robots, per text."""
_ALIKE = 0.8


class _Budget:
    """How many words may still be compared with all names."""

    def __init__(self) -> None:
        self.left = MAX_GUESSES


class _Roster(Struct, frozen=True):
    names: dict[tuple[str, ...], tuple[str, ...]]
    """Robots by the letters and numbers of their names: ("rover", "1")."""
    kinds: dict[tuple[str, ...], tuple[str, ...]]
    """Robots by the prefix of their names, in singular and plural."""
    joined: tuple[str, ...]
    all: tuple[str, ...]
    longest: int


@functools.lru_cache(maxsize=8)
def _roster(robots: tuple[str, ...]) -> _Roster:
    names: dict[tuple[str, ...], list[str]] = {}
    kinds: dict[tuple[str, ...], list[str]] = {}
    for robot in robots:
        parts = tuple(re.findall(r"[^\W\d_]+|\d+", _plain(robot)))
        # A robot that has a stop word for a name can only be stopped with all the others.
        if not parts or parts in _VOCABULARY:
            continue
        names.setdefault(parts, []).append(robot)
        number = next((at for at, each in enumerate(parts) if each.isdigit()), 0)
        prefix = parts[:number] if number else parts[:1] if parts[0] in _KINDS and len(parts) > 1 else ()
        if prefix and prefix not in _VOCABULARY:
            kinds.setdefault(prefix, []).append(robot)
            kinds.setdefault((*prefix[:-1], f"{prefix[-1]}s"), []).append(robot)
    return _Roster(
        names={parts: tuple(each) for parts, each in names.items()},
        kinds={parts: tuple(each) for parts, each in kinds.items()},
        joined=tuple("".join(each) for each in names),
        all=robots,
        longest=max((len(each) for each in (*names, *kinds)), default=0),
    )


class _Heard:
    """The robots of one clause."""

    def __init__(self) -> None:
        self.robots: list[str] = []
        self.unknown: list[str] = []
        self.everything = False

    @property
    def fleet(self) -> bool:
        return self.everything or not (self.robots or self.unknown)


def _named(tokens: Sequence[str], at: int, roster: _Roster, heard: _Heard) -> int:
    """Take the robots that are named at a place; the tokens taken, 0 when there is none."""
    for length in range(min(roster.longest, len(tokens) - at), 0, -1):
        parts = tuple(tokens[at : at + length])
        if (found := roster.names.get(parts)) is not None:
            heard.robots += found
            return length + _more(tokens, at + length, parts[:-1], roster, heard)
    for length in range(min(roster.longest, len(tokens) - at), 0, -1):
        parts = tuple(tokens[at : at + length])
        if (found := roster.kinds.get(parts)) is not None:
            return length + _of_kind(tokens, at + length, found, parts, roster, heard)
    kind = _KINDS.get(tokens[at])
    if kind is None:
        return 0
    found = roster.kinds.get((kind,), ())
    if not found and (tokens[at],) in _VOCABULARY and not _number(tokens, at + 1):
        return 0  # "the robots": all of them
    return 1 + _of_kind(tokens, at + 1, found, (tokens[at],), roster, heard)


def _of_kind(
    tokens: Sequence[str], at: int, found: Sequence[str], said: tuple[str, ...], roster: _Roster, heard: _Heard
) -> int:
    """Take the number behind "rover" or "rovers", or all robots of that kind when there is none."""
    kind = _KINDS.get(said[-1], said[-1])
    prefix = (*said[:-1], kind if (*said[:-1], kind) in roster.kinds else kind.removesuffix("s"))
    skip = int(at < len(tokens) and tokens[at] in _NUMBER)
    if not (number := _number(tokens, at + skip)):
        heard.robots += found
        if not found:
            heard.unknown.append(" ".join(said))
        return 0
    _numbered(prefix, number, roster, heard)
    return skip + 1 + _more(tokens, at + skip + 1, prefix, roster, heard)


def _more(tokens: Sequence[str], at: int, prefix: tuple[str, ...], roster: _Roster, heard: _Heard) -> int:
    """Take the numbers that follow: "rover 1, 2 and 3"."""
    taken = 0
    while prefix:
        ahead = taken
        while at + ahead < len(tokens) and (tokens[at + ahead] == "," or tokens[at + ahead] in _AND):
            ahead += 1
        number = _number(tokens, at + ahead)
        if ahead == taken or not number:
            break
        _numbered(prefix, number, roster, heard)
        taken = ahead + 1
    return taken


def _number(tokens: Sequence[str], at: int) -> str:
    if at >= len(tokens):
        return ""
    return tokens[at] if tokens[at].isdigit() else _NUMBERS.get(tokens[at], "")


def _numbered(prefix: tuple[str, ...], number: str, roster: _Roster, heard: _Heard) -> None:
    if (found := roster.names.get((*prefix, number))) is not None:
        heard.robots += found
    else:
        heard.unknown.append(f"{'_'.join(prefix)}{number}" if len(prefix) == 1 else "_".join((*prefix, number)))


def _mistyped(tokens: Sequence[str], at: int, roster: _Roster, heard: _Heard, budget: _Budget) -> int:
    """Take a word that looks like a robot's name with a typing error: "rovr_1"."""
    best, taken = _ALIKE, 0
    for length in (3, 2, 1):
        parts = tokens[at : at + length]
        said = "".join(parts)
        # "bob rover 2" is no name: a robot or a known word begins within it.
        if any(
            _known(tokens, at + ahead)[0] or _named(tokens, at + ahead, roster, _Heard())
            for ahead in range(1, len(parts))
        ):
            continue
        if len(parts) < length or "," in parts or "§" in parts or not 3 <= len(said) <= 40 or budget.left <= 0:
            continue
        budget.left -= 1
        matcher = difflib.SequenceMatcher(b=said, autojunk=False)
        numbered = any(each.isdigit() for each in parts)
        for name in roster.joined:
            if numbered != any(each.isdigit() for each in name) or len(name) > 2 * len(said):
                continue
            matcher.set_seq1(name)
            if matcher.real_quick_ratio() >= best and (ratio := matcher.ratio()) >= best:
                best, taken = ratio, length
    if taken:
        heard.unknown.append("".join(tokens[at : at + taken]))
    return taken


# --- sentences --------------------------------------------------------------------------------------------------


def _sentence(said: _Sentence, roster: _Roster, budget: _Budget) -> _Heard | None:
    """Return the stop of a sentence: all of it, its first clauses, or its last one with an exclamation mark."""
    tokens = said.tokens
    if not _has_stop(tokens) or (not said.first and tokens == ["full", "stop"]):
        return None
    if (heard := _clause(tokens, roster, budget, first=said.first, question="?" in said.mark)) is not None:
        return heard
    if (heard := _with_reason(said, roster, budget)) is not None:
        return heard
    commas = [at for at, each in enumerate(tokens) if each == ","]
    for comma in commas[:3]:
        behind = next((each for each in tokens[comma + 1 :] if each != ","), "")
        if behind in _CONDITIONS:
            break
        if behind and (heard := _clause(tokens[:comma], roster, budget, first=said.first)) is not None:
            return heard
    if commas and "!" in said.mark and _CONDITIONAL.isdisjoint(tokens):
        return _clause(tokens[commas[-1] + 1 :], roster, budget, first=False)
    return None


_REASONS = frozenset(
    re.findall(
        r"\S+",
        "there's theres there it's its it he's hes he she's she they're they someone somebody something because "
        "cause cos cuz from you're youre that's thats man woman child kid children people person worker workers "
        "fire smoke",
    )
)
"""Words that begin the reason of a stop: "stop the rover there's a child"."""
_THERE = frozenset(("is", "are", "was", "were", "has", "have", "might", "may", "must", "could", "can", "will", "comes"))
"""Words behind "there" that say what is there; behind others it says where to stop."""


def _with_reason(said: _Sentence, roster: _Roster, budget: _Budget) -> _Heard | None:
    """Return the stop that a sentence begins with where its reason follows without a mark between them."""
    tokens = said.tokens
    for at in range(1, min(len(tokens) - 1, 14)):
        if tokens[at] not in _REASONS or tokens[at : at + 4] == ["from", "time", "to", "time"]:
            continue
        if tokens[at - 1 : at + 1] == ["over", "there"]:
            continue  # where a robot is to stop: a step of a task
        if tokens[at] == "there" and tokens[at + 1] not in _THERE:
            continue  # "go to dock 1. Stop there and photograph it"
        heard = _clause(tokens[:at], roster, budget, first=said.first)
        # "stop something": without robots only a thing that is there is a reason.
        if heard is not None and (
            heard.robots or heard.everything or tokens[at].startswith(("there", "because", "cos"))
        ):
            return heard
    return None


def _clause(
    tokens: Sequence[str],
    roster: _Roster,
    budget: _Budget,
    *,
    first: bool,
    question: bool = False,
    names: bool = False,
) -> _Heard | None:
    """Return the stop that a clause is; None when a word of it is neither stop word, robot nor courtesy.

    With `names` it needs no stop word, but robots: the clause before it is the stop.
    """
    if question and tokens[0] in _ASKING:
        return None
    clause = _Clause(first=first, question=question)
    at = 0
    while at < len(tokens):
        kind, taken = _known(tokens, at)
        if tokens[at] == ",":
            pass
        elif (named := _named(tokens, at, roster, clause.into)) > 0:
            clause.names()
            taken = named
        elif kind is not None:
            if not clause.takes(kind, tokens, at):
                return None
        elif tokens[at] in _AND:
            # "Go to dock 1. And stop." is a step of a task.
            if clause.empty and not first and not names:
                return None
        elif (taken := _mistyped(tokens, at, roster, clause.into, budget)) > 0:
            clause.names()
        else:
            return None
        at += taken
    return clause.result(roster, names=names)


class _Clause:
    """What the words of a clause said so far."""

    def __init__(self, *, first: bool, question: bool) -> None:
        self.into = self._heard = _Heard()
        """The robots that are stopped, or those excepted from it."""
        self.article = False
        """An article waits for its robots."""
        self._spared = _Heard()
        self._first = first
        self._question = question
        self._stops = self._each = False

    @property
    def empty(self) -> bool:
        """Whether neither a stop word nor a robot was said."""
        return not (self._stops or self._heard.robots or self._heard.unknown)

    def names(self) -> None:
        """Note that robots were named: what led to them is done with."""
        self.article = self._each = False

    def takes(self, kind: _Kind, tokens: Sequence[str], at: int) -> bool:
        """Take a known phrase; False when the clause is no stop for it."""
        match kind:
            case _Kind.STOP:
                self._stops = True
                return not self.article
            case _Kind.ALL:
                self.into.everything = self.into.everything or self._each or tokens[at] not in _GENERIC
                self.article = self._each = False
            case _Kind.EACH:
                self.article, self._each = False, True
            case _Kind.ARTICLE:
                self.article = True
            case _Kind.NO:
                return _interjection(tokens, at)
            case _Kind.MUST:
                return not self._question
            case _Kind.NEXT:
                self._stops = self._stops or tokens[at] in _STOPS_HERE
                return self._first
            case _Kind.EXCEPT:
                self.into = self._spared
            case _Kind.COURTESY:
                pass
        return True

    def result(self, roster: _Roster, *, names: bool) -> _Heard | None:
        if self.article or not (self._stops or (names and (self._heard.everything or not self.empty))):
            return None
        spared = self._spared
        if spared.robots or spared.unknown or spared.everything:
            return _without(self._heard, spared, roster)
        return self._heard


def _without(heard: _Heard, spared: _Heard, roster: _Roster) -> _Heard | None:
    """Return the stop of robots but some: "all but rover_1"."""
    base = heard.robots or ([] if heard.unknown else roster.all)
    found = _Heard()
    found.robots = [each for each in base if each not in spared.robots]
    found.unknown = [*heard.unknown, *spared.unknown]
    return None if found.fleet or spared.everything else found


def _interjection(tokens: Sequence[str], at: int) -> bool:
    """Return whether "no" is an outcry and does not negate what follows."""
    following = tokens[at + 1] if at + 1 < len(tokens) else ","
    if following == "," or _VOCABULARY.get((following,)) is _Kind.NO:
        return True
    return tokens[at] in _BEFORE_NAMES and following not in _IBERIAN
