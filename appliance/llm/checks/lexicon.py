"""Words of English that checks know: small words, and words that change what an order means.

Skills' own words are not here: they stand in their manifests (`phrases`).
"""


def _set(text: str) -> frozenset[str]:
    return frozenset(text.split())


NEGATIONS = _set(
    "not no never none nobody nothing neither nor without avoid avoiding refuse refrain refraining cancel skip omit "
    "forget don't dont doesn't doesnt didn't shouldn't shouldnt mustn't mustnt can't cant cannot won't wont "
    "wouldn't isn't aren't n't quits quitting ceases ceasing halts aborts cancels cancelling skips skipping omits "
    "forgets avoids refuses refusing refrains prohibited forbidden forbid forbids prohibit stop stops cease quit "
    "abort halt unnecessary disregard ignore ignoring prevent hardly barely"
)
"""Words that forbid what follows."""
EXCEPTIONS = _set(
    "than unless except excepting excluding exclude other-than save bar barring apart instead rather but-not only"
)
"""Words that take something out of an order."""
CONDITIONS = _set(
    "if provided providing assuming suppose supposing otherwise else whether whenever depending depends case "
    "condition granted given lest in-case"
)
"""Words that make an order depend on the world."""
TIMES = _set(
    "tomorrow tonight today yesterday later noon midnight midday morning afternoon evening night daily hourly "
    "nightly weekly monthly monday tuesday wednesday thursday friday saturday sunday week month year clock strikes "
    "am pm a.m p.m o'clock oclock periodically regularly repeatedly continuously constantly forever always schedule "
    "scheduled overnight midweek fortnight fortnightly hence presently sunrise sunset dawn dusk lunchtime lunch "
    "shift weekday weekdays weekend weekends delay delayed minutely again repeat repeats eventually sometime "
    "whenever continually"
)
"""Words of clock times, dates and repeats."""
ALTERNATIVES = _set(
    "or either whichever whatever perhaps maybe alternatively possibly preferably might possible probably optionally"
)
"""Words that leave open what is meant."""
CORRECTIONS = _set("no scratch sorry actually correction rather oops wrong instead mean meant strike nope belay undo")
"""Words that take back what was said before."""
AGAIN = _set("twice thrice again times each every more both")
"""Words that ask for a thing more than once."""
RESULTS = _set(
    "result results finding findings reading readings pic pics picture pictures photo photos photograph photographs "
    "image images video footage recording recordings scan scans map maps count counts detection detections "
    "update updates transcript report data clip clips sound audio list round"
)
"""Nouns for what earlier steps bring: a later step works on them without naming them in the plan."""
SUBJECTS = _set(
    "status state position positions location temperature battery level levels damage damages progress smoke leak "
    "leaks condition number people obstacles anomalies defects faults issues problems"
)
"""Nouns for what may be reported without "about"."""
WAYS = _set("goto dock")
"""Skills that go to the place they name."""
PRONOUNS = _set("it them they he she him her his its that this these those there here")
"""Words that stand for something said before."""
THINGS = _set("it that this them these those")
NAMELESS = THINGS | _set("me there here something thing stuff somewhere anything")
"""Words that name no thing or place by themselves."""
SEQUENCE = _set("then afterwards next finally subsequently lastly thereafter thereupon")
"""Words between an order and the one that follows it."""
SIDE_BY_SIDE = _set("while whilst meanwhile simultaneously")
"""Words between orders that run at the same time."""
UNITS = _set(
    "m metre metres meter meters cm km s sec secs second seconds min mins minute minutes h hr hrs hour hours ft "
    "foot feet mph kmh kph mps knot knots degree degrees deg percent yard yards mile miles inch inches day days ms"
)
"""Words behind a figure."""
BY_THE_WAY = _set("via stopping calling passing")
"""Words between where a robot goes and what it passes before."""
NOUNS_IN_ING = _set(
    "loading unloading packing sorting meeting training cleaning briefing "
    "building painting ceiling railing crossing clearing lighting awning bearing casing wiring piping flooring "
    "scaffolding roofing glazing cladding coupling fitting opening housing mounting coating ring wing string king "
    "drawing sling spring swing sting packing tubing ducting decking siding grating plumbing rigging landing parking"
)
"""Nouns that look like verbs."""
DURATIONS = _set("second seconds sec secs minute minutes min mins hour hours hr hrs ms day days")
"""Units of time."""
ASKING = _set("did does was were who where why has is are what which whose am")
"""First words of a question."""
DELIVERY = _set(
    "bring brings bringing deliver delivers delivering carry carries carrying transport transports take takes taking"
)
"""Verbs of bringing a thing to where it stays."""
SUBORDINATE = _set("reaches arrives lands returns comes goes finishes stands")
"""Verbs of robots that say when something is to happen."""
IN_NO_NAME = _set(
    "rid till midnight noon tomorrow tonight daily hourly than unless without quarter half double turn degrees percent "
    "for at to while then until overnight always forever again sometimes times laps infinity once twice every "
    "before after when where which"
)
"""Words that stand in no name of a thing or place."""
FIXTURES = _set(
    "stopcock tap switch breaker light lights lamp lamps door doors gate gates window windows lid hatch valve fan "
    "fans heater pump pumps machine alarm belt drawer cabinet shutter shutters power engine motor radio siren "
    "beacon camera printer screen "
    "toolbox locker cupboard container bin freezer fridge tailgate barrier turnstile roller blind blinds curtain flap"
)
"""Things that are there on most sites, whether the map lists them or not."""
NOUNS_TOO = _set(
    "stop stops halt abort cancel skip save bar case condition given mean right wrong rather next ignore quit "
    "prevent last lastly finally"
)
"""Such words that stand in names, too: the stop sign, Mr Halt."""
AWAY = frozenset((("away", "from"), ("out", "of"), ("clear", "of"), ("far", "from"), ("off", "of"), ("back", "from")))
"""Words before a place that a robot is to leave."""
NUMBERED = _set(
    "dock docks goal goals bay bays aisle aisles waypoint waypoints station stations shelf shelves rack racks gate "
    "gates room rooms table tables number no nr point points slot slots zone zones area areas"
)
"""Nouns behind which a figure is a number, and counts nothing."""
GUARDS = (NEGATIONS | CONDITIONS | EXCEPTIONS | ALTERNATIVES | CORRECTIONS | SEQUENCE | SIDE_BY_SIDE) - NOUNS_TOO
"""Words that no name of a thing or place accounts for."""
NO_NAME = _set(
    "it this that these those which what who whom whose whatever whichever whoever latter former same other others "
    "another one ones any anything some something someone somebody everything nothing nobody rest remainder thing "
    "things stuff whatsit thingy gizmo someplace somewhere anywhere elsewhere everywhere "
    "mark signal cue command say-so care charge turn chance moment while future "
    "come comes coming monday tuesday wednesday thursday friday saturday sunday today tomorrow tonight yesterday "
    "noon midnight later soon ago next last previous usual "
    "not never no without unless except forget forgot asked wait oops argh ugh sorry please thanks"
)
"""Words that are part of no name: a value with one of them says nothing, or has taken in words that mean more."""
MANNER = _set(
    "upside upright backwards backward forwards forward sideward sidewards inwards outwards upwards downwards aloud "
    "alone together apart headfirst feet-first face-down fast slow hard soft loud quiet tight loose straight"
)
"""Words that say how something is done, and name nothing."""
NOUNS_IN_LY = _set(
    "assembly supply family dolly trolly gully jelly belly lily lolly bully anomaly fly ply butterfly monopoly"
)
"""Nouns that look like adverbs."""
ORDINALS = _set("second third fourth fifth sixth seventh eighth ninth tenth")
COUNTS = _set("two three four five six seven eight nine ten dozen hundred thousand several many few couple")
