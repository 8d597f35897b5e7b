"""Stop words: which texts are a soft stop, of which robots, and which only look like one."""

import string
import sys
from types import FrameType

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.llm.stop_words import StopRequest, mentions_stop, stop_request

ROBOTS = ("rover_1", "rover_2", "drone_1", "drone_2", "Arm-7")
ROVERS, DRONES = ("rover_1", "rover_2"), ("drone_1", "drone_2")

FLEET = """
stop
STOP
Stop!
STOP!!!
stop.
stop?!
  stop

stop stop stop
no no no stop
oh god stop
STOOOOP
s t o p
S.T.O.P.
sotp
st0p
ѕtор
s\u200bt\u200bo\u200bp
\u202estop\u202c
ｓｔｏｐ
𝐒𝐓𝐎𝐏
**stop**
/stop
🛑
halt
HALT!
freeze
abort
abort mission
abort the mission!
cease
e-stop
E-STOP NOW
estop
emergency stop
Emergency stop!!!
full stop
all stop
stop now
stop right now
stop immediately
please stop
stop, please
Stop at once!
could you stop please?
can you stop?
stop everything
stop everybody
stop everyone now
everyone stop
hold everything
stand still
everybody stand still
stay where you are
do not move
don't move
nobody move
stop all
stop all robots
stop the robots
stop the robot
stop the fleet
stop all of them
stop rover_1 and all robots
stop rover_1; everything!
stop it
stop moving
all of you must stop
i said stop
make them stop
tell everyone to stop
stop right there
stop, you are going to hit the wall
Stop - there is a child!
it is going to hit the shelf, stop!
stop and hold position
Rover_1 go to dock 1. STOP!
Rover_1 go to dock 1; stop
wait... stop
No! Stop!
go to the dock.STOP
halt where you are
all stations all stations halt now over
I am terribly sorry to interrupt, but would you be so kind as to halt every robot this very instant
for god's sake stop
стоп
стой!
停止
止まれ
멈춰
रुको
ruk jao abhi
قف
dur
alto
¡Alto!
para
¡Para ya!
pare
parad
detente
deténgase
detengase
deteneos
por favor para
para todo
alto a todos
parada de emergencia
no te muevas
parem
parem todos
pare tudo
pare imediatamente
parada de emergência
arrête
arrete
arrêtez
ARRÊTEZ TOUT
arrête-toi
arrêter
halte
halte là !
arrêt d'urgence
arrêtez-vous s'il vous plaît
ne bougez plus
stopp
Stopp, sofort!
alle Roboter anhalten
bitte anhalten
stehen bleiben
Bleiben Sie stehen!
Nothalt
nicht bewegen
fermati
fermi tutti
ferma tutto
fermo
fermatevi subito
alt
arresto di emergenza
stoppen
alles stoppen
noodstop
sta stil
stój
stój!
zatrzymaj
zatrzymaj się
proszę zatrzymać wszystko
zatrzymajcie się natychmiast
"""

NAMED = {
    "rover_1 stop": ("rover_1",),
    "for gods sake make rover_1 stop": ("rover_1",),
    "rover two stop where you are man in the aisle": ("rover_2",),
    "Rover_1 stop": ("rover_1",),
    "Rover_1: stop!": ("rover_1",),
    "ROVER 1 STOP": ("rover_1",),
    "rover1 stop": ("rover_1",),
    "rover one, stop": ("rover_1",),
    "stop rover_1": ("rover_1",),
    "please stop rover-1 immediately": ("rover_1",),
    "stop arm 7": ("Arm-7",),
    "stop the arm": ("Arm-7",),
    "stop rover_1 and drone_2": ("rover_1", "drone_2"),
    "stop rover 1, rover 2 and drone_1": ("rover_1", "rover_2", "drone_1"),
    "stop rovers 1 and 2": ROVERS,
    "rover 1 and 2 stop": ROVERS,
    "stop the drone": DRONES,
    "stop the drones!": DRONES,
    "drones: stop": DRONES,
    "stop all drones": DRONES,
    "both rovers halt": ROVERS,
    "every rover stop": ROVERS,
    "stop all of the rovers": ROVERS,
    "halt both drones and rover_1": ("drone_1", "drone_2", "rover_1"),
    "make rover_1 stop": ("rover_1",),
    "tell rover_1 to stop": ("rover_1",),
    "rover_1 must stop now": ("rover_1",),
    "can you stop rover_1?": ("rover_1",),
    "rover_1 stop and wait": ("rover_1",),
    "stop everyone but rover_1": ("rover_2", "drone_1", "drone_2", "Arm-7"),
    "stop all rovers except rover_2": ("rover_1",),
    "para el rover_1": ("rover_1",),
    "rover_1 arrête-toi": ("rover_1",),
    "stopp die drohnen": DRONES,
    "drone_1 fermati": ("drone_1",),
    "rover_2 stój": ("rover_2",),
    "Rover_1: go to dock 1; drone_1: stop": ("drone_1",),
    "Rover_1 stop. Drone_1 stop.": ("rover_1", "drone_1"),
    "rover_1, stop, you hit the wall": ("rover_1",),
    "stop robot rover_1": ("rover_1",),
    "stop the robots rover_1 and drone_1": ("rover_1", "drone_1"),
    "stop rover number 1": ("rover_1",),
    "stop rover_1; rover_2!": ROVERS,
    "stop rover_1. Drone_1, land": ("rover_1",),
    "rover_1 halte an": ("rover_1",),
}

UNKNOWN = {
    "stop rover_9": ((), ("rover9",)),
    "stop rover 1 and rover 9": (("rover_1",), ("rover9",)),
    "stop rovr_1": ((), ("rovr1",)),
    "stop robot 3": ((), ("robot3",)),
    "stop the uav": ((), ("uav",)),
}

NO_STOP = """
stop filming
Rover_1 stop filming
stop at dock 1
rover_1 stop at dock 1
go to dock 1 and stop
Rover_1: go to dock 1 and stop
Rover_1: go to dock 1, then stop
Rover_1 go to dock 1. Then stop.
Rover_1 go to dock 1. And stop.
Rover_1 go to dock 1. Stop there.
Rover_1 go to dock 1 and stop there
Rover_1 go to dock 1. Stop over there and photograph the shelf
Rover_1 go to the gate. Stop over there please
Go to dock 1. Stop there and photograph it
Rover_1 go to dock 1. Stop there for 5 seconds
go to the bus stop
bus stop
the bus stop
the next stop
the stop
a stop
make a stop
pit stop
stop sign
photograph the stop sign
read the stop sign
stop when you see a person
stop, when you see a person
stop if the battery is low
if you see a person, stop!
rover_1: if you see a person, stop!
stop after 5 s
stop for 5 s
stop in 10 seconds
stop 5 m before the wall
stop before dock 1
stop until i say go
stop going to dock 1
stop following drone_1
stop the video
stop the recording
stop the engine of the forklift
stop the conveyor
stop the music
stop talking
stop using dock 1
don't stop
dont stop
do not stop
never stop
Rover_1 do not stop
drone_1 should not stop
no pares
no pare
não pare
ne t'arrête pas
nicht anhalten
non fermarti
niet stoppen
nie zatrzymuj się
"stop"
'stop'
“stop”
«stop»
„stopp“
say "stop"
Rover_1: say "stop"
Rover_1: say "Stop. Go to dock 1."
Rover_1 say 'stop!'
Rover_1: say stop
announce: stop
why did it stop?
why did rover_1 stop?
when does rover_1 stop?
did rover_1 stop?
does it stop?
is rover_1 stopped?
should rover_1 stop?
where is the next stop?
what does halt mean?
do you want to stop?
will rover_1 stop?
caja para Ana
para Ana
lleva la caja para el almacén
una caja para rover_1
trae agua para todos
Rover_1 go to Halt
go to Alto
Rover_1 go to Hotel Alto
Ana Alto
mas alto
vuela más alto
das ist halt so
arrêt de bus
va à l'arrêt de bus
stop-motion video
non-stop
nonstop
one-stop shop
halt and catch fire
cease fire
freeze frame
freeze the ice cream
abort t-1234
halting
stopped
stop1
stop 1
dock_stop
stops
unstoppable
hold
hold position
wait
pause
go to dock 1
land
rover_1
please
now
drone_1 drone_2
.
!!!
"""


def _cases(text: str, between: str = "\n") -> list[str]:
    return [each for each in text.split(between) if each]


@pytest.mark.parametrize("text", _cases(FLEET))
def test_stops_of_the_fleet(text: str) -> None:
    """Stops of the fleet."""
    for robots in (ROBOTS, ()):
        found = stop_request(text, robots)
        assert found == StopRequest()
        assert mentions_stop(text)


@pytest.mark.parametrize("text", NAMED)
def test_stops_of_robots(text: str) -> None:
    """Stops of robots."""
    assert stop_request(text, ROBOTS) == StopRequest(robots=NAMED[text])


@pytest.mark.parametrize("text", UNKNOWN)
def test_names_that_no_robot_has_are_reported(text: str) -> None:
    """Names that no robot has are reported."""
    robots, unknown = UNKNOWN[text]
    assert stop_request(text, ROBOTS) == StopRequest(robots=robots, unknown=unknown)


@pytest.mark.parametrize("text", _cases(NO_STOP))
def test_what_only_looks_like_a_stop(text: str) -> None:
    """What only looks like a stop."""
    assert stop_request(text, ROBOTS) is None
    assert stop_request(text, ()) is None


def test_there_are_enough_cases() -> None:
    """There are enough cases."""
    assert len(_cases(FLEET)) + len(NAMED) >= 60
    assert len(_cases(NO_STOP)) >= 60


def test_a_line_is_a_sentence() -> None:
    """A line is a sentence."""
    assert stop_request("Rover_1 go to dock 1\nstop", ROBOTS) == StopRequest()


def test_a_robot_of_another_kind_of_name() -> None:
    """A robot of another kind of name."""
    assert stop_request("stop alpha", ("alpha", "beta")) == StopRequest(robots=("alpha",))
    assert stop_request("stop alhpa", ("alpha", "beta")) == StopRequest(unknown=("alhpa",))
    assert stop_request("stop delivery bot 2", ("delivery_bot_2",)) == StopRequest(robots=("delivery_bot_2",))
    assert stop_request("stop the delivery bots", ("delivery_bot_2",)) == StopRequest(robots=("delivery_bot_2",))
    assert stop_request("stop halt_1", ("halt_1",)) == StopRequest(robots=("halt_1",))
    assert stop_request("halt_1 go to dock 1", ("halt_1",)) is None
    # A stop word stays one when a robot has it for a name.
    assert stop_request("alto", ("alto", "rover_1")) == StopRequest()


def test_an_unknown_roster_keeps_the_names() -> None:
    """An unknown roster keeps the names."""
    assert stop_request("rover_1 stop", ()) == StopRequest(unknown=("rover1",))


# --- properties -------------------------------------------------------------------------------------------------

WORDS = _cases(
    "stop|halt|freeze|abort|cease|estop|e-stop|emergency stop|hold everything|stand still|stay where you are|alto|"
    "para|pare|parad|detente|deténgase|deteneos|parar|parem|arrête|arrêtez|arrêter|halte|stopp|anhalten|"
    "stehen bleiben|fermati|ferma|fermo|alt|stoppen|stój|zatrzymaj|zatrzymaj się",
    "|",
)
OBJECTS = _cases(
    "filming|the video|talking to Ana|the conveyor|the door|recording audio|the music|the washing machine in room 4|"
    "5 times|at dock 1|when it rains|la caja|den Motor|la música|le moteur|il motore|de motor|silnik",
    "|",
)
SPACE = st.text(" \t\n", max_size=3)
MARKS = st.text("!.… ?¡¿-*#~,;:()🙏", max_size=5)


def _cased(word: str, choices: list[bool]) -> str:
    return "".join(char.upper() if choices[at % len(choices)] else char.lower() for at, char in enumerate(word))


@given(
    st.sampled_from(WORDS), st.lists(st.booleans(), min_size=1, max_size=8), SPACE, MARKS, SPACE, MARKS, st.booleans()
)
def test_a_stop_word_alone_is_a_stop(
    word: str, cases: list[bool], before: str, left: str, after: str, right: str, with_roster: bool
) -> None:
    """In any case, between any marks and blanks."""
    text = f"{before}{left} {_cased(word, cases)} {right}{after}"
    assert stop_request(text, ROBOTS if with_roster else ()) == StopRequest()


@given(st.sampled_from(WORDS), st.sampled_from(['""', "“”", "«»", "„“", "''", "‘’"]), st.sampled_from(["", " ", "!"]))
def test_a_quoted_stop_word_is_none(word: str, quotes: str, mark: str) -> None:
    """A quoted stop word is none."""
    assert stop_request(f"{quotes[0]}{word}{mark.strip()}{quotes[1]}{mark}", ROBOTS) is None
    assert stop_request(f"Rover_1: say {quotes[0]}{word}{quotes[1]}", ROBOTS) is None


@given(st.sampled_from(WORDS), st.sampled_from(OBJECTS), st.sampled_from(["", ".", "!"]))
def test_a_stop_word_with_another_object_is_none(word: str, what: str, mark: str) -> None:
    """A stop word with another object is none."""
    assert stop_request(f"{word} {what}{mark}", ROBOTS) is None


@given(
    st.text() | st.text("stop halt rover_1 \"'“”.,!?;:-§no", max_size=200), st.lists(st.text(max_size=12), max_size=6)
)
def test_it_never_raises(text: str, robots: list[str]) -> None:
    """It never raises."""
    found = stop_request(text, robots)
    assert found is None or set(found.robots) <= set(robots)
    mentions_stop(text)


@given(st.text(string.ascii_letters + " \"'", max_size=60))
def test_what_is_a_stop_mentions_one(text: str) -> None:
    """What is a stop mentions one."""
    assert mentions_stop(text) or stop_request(text, ROBOTS) is None


@pytest.mark.parametrize(
    "part",
    [
        *("stop ", "stop. ", "stop, ", "stop rovr_3, ", '"', "“", "'a ", "„“”", "s t o p ", "rover 1 and ", "stop no "),
        *("\u0301", "stop rover_9! ", "don't ", '“a"', "....", "ﷺ", "stopstop", "1.", "stop the ", "e ", "stay where "),
    ],
)
def test_long_texts_take_linear_time(part: str) -> None:
    """A text ten times as long takes no more than some ten times the calls, whatever stands in it."""
    roster = tuple(f"rover_{each}" for each in range(300))
    text = (part * (20_000 // len(part) + 1))[:20_000]
    stop_request("stop", roster)
    assert calls_of(text, roster) <= 12 * calls_of(text[:2_000], roster) + 100


def calls_of(text: str, roster: tuple[str, ...]) -> int:
    """Count the calls of functions, methods and built-ins in one look for a stop."""
    count = 0

    def called(_frame: FrameType, event: str, _argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(called)
    try:
        stop_request(text, roster)
    finally:
        sys.setprofile(before)
    return count


@pytest.mark.parametrize(
    ("text", "robots"),
    [
        ("oh god stop the rover theres a kid", ("rover_1",)),
        ("stop there's a person", ()),
        ("stop rover_1 it's going to hit him", ("rover_1",)),
        ("stop everything someone fell", ()),
        ("halt drone_1 because it smokes", ("drone_1",)),
        ("stop the rover from crashing", ("rover_1",)),
    ],
)
def test_a_stop_with_its_reason_behind_it_is_a_stop(text: str, robots: tuple[str, ...]) -> None:
    """Who shouts gives the reason in the same breath, without a comma."""
    stop = stop_request(text, ["rover_1", "drone_1"])
    assert stop is not None
    assert stop.robots == robots


@pytest.mark.parametrize(
    "text", ["stop something", "stop filming it", "stop people at the gate", "stop the rover from time to time"]
)
def test_what_follows_is_a_reason_only_behind_a_whole_stop(text: str) -> None:
    """An object of the verb is none."""
    assert stop_request(text, ["rover_1", "drone_1"]) is None
