"""Words of English that checks know: small words, and words that change what an order means.

Skills' own words are not here: they stand in their manifests (`phrases`).
"""


def _set(text: str) -> frozenset[str]:
    return frozenset(text.split())


FILLERS = _set(
    "sending having getting taking thx dear the a an my our your its his her their some of to at in on into onto "
    "from with by near for via through inside towards toward until till upon there here then next after afterwards "
    "before once when while whilst meanwhile and also too plus as so first firstly second secondly third thirdly "
    "fourth finally lastly last subsequently please kindly pls plz thanks thank hey hi hello ok okay alright right "
    "good now immediately straight directly just simply both each done finished finnished complete completed ready "
    "arrived landed airborne it they he she you we i me us them him who which that this these those be been being "
    "is are has have had do does did get got let make made making tell order command instruct send must shall will "
    "should may need needs want like task job mission step steps everything following follows during same time "
    "parallel simultaneously together respectively soon own one ones itself themselves robot proceed begin begins "
    "start starts starting carry perform doing go execute sure ahead using use available fetch base gateway site "
    "warehouse yard out over along across carefully safely another other locally local between among amongst "
    "against but every all well copy roger break uh um er erm hm hmm cheers mister mate folks yourself yourselves "
    "himself herself thereafter whereupon pronto asap i'd we'd you'd"
)
"""Words that may stand beside a plan without being in it."""
FILLER_PHRASES = (
    "good morning", "good afternoon", "good evening", "good day", "morning !", "morning ,", "evening !", "i . e", "i.e",
    "i'd appreciate it if", "we'd appreciate it if", "it'd be good if", "it would be good if", "be so kind as to",
    "make their way", "make its way", "make your way", "the way to", "hi there", "hello there", "hey there", "hey team",
    "hi team",
    "my friend", "hey buddy", "buddy", "pal", "lads", "colleague", "dear colleague", "so much", "very much", "ta",
    "when you get a sec", "when you get a second", "when you get a moment", "when you get a minute", "is wanted at",
    "is wanted in", "wants to be at", "wants to be in", "- >", "->", "when you're ready", "when you are ready",
    "could you please", "would ROBOT mind", "mind sending", "mind flying", "mind driving", "mind going", "mind taking",
    "mind moving", "mind bringing", "mind getting", "mind having",
    "where it is", "where it stands", "where they are", "at the end", "in position", "has answered",
    "have answered", "how many there are", "is answered", "no problem at all", "no problem", "no worries",
    "no rush", "without exception", "if you would be so kind", "be so kind", "i would appreciate it if",
    "we would appreciate it if", "excuse me", "would it be possible for you to", "how about you", "as you go",
    "do n't forget to", "don't forget to", "do not forget to", "don't hesitate to",
    "do not hesitate to", "i would like", "i'd like", "we would like", "we'd like", "would like you to",
    "could you", "can you", "would you", "will you", "could somebody", "could someone", "can somebody",
    "can someone", "would you mind", "would you please", "if you can", "if you please", "if you would",
    "if you don't mind", "could you have", "can i have", "can we have", "could i have", "could we have",
    "may i have", "i want", "i need", "we want", "we need", "make sure", "be sure", "in that order",
    "in this order", "in order", "one after the other", "one by one", "right away", "right now", "straight away",
    "at once", "as well", "all the way", "when you are done", "when you're done", "once you are done",
    "once you're done", "that's", "it's", "it has", "they've", "let's", "you've", "you have", "in the meantime",
    "at the same time", "as soon as", "thank you", "no hurry", "is to", "are to", "has to", "have to", "needs to",
    "need to", "got to", "go ahead", "go and", "from there", "over there", "over here", "by the way", "for me",
    "for us", "your job is", "on arrival", "upon arrival", "will do", "would be great", "would be nice",
    "would be lovely", "would be much appreciated", "is much appreciated", "much appreciated", "when you like",
    "if i may trouble you", "if i may", "if it's no trouble", "if it is no trouble", "if it's not too much trouble",
    "if that's alright", "if that's ok", "if that's okay", "if that is ok", "if it pleases you",
    "if you wouldn't mind", "be so good as to", "be good enough to", "be a dear and", "do me a favour and",
    "do me a favor and", "followed by", "i'd love", "we'd love", "i would love", "i'd appreciate",
    "i would appreciate", "we'd appreciate", "grateful if", "i'd be grateful if", "i would be grateful if",
    "it'd be great if", "it would be great if", "it would be nice if", "i'd be glad if", "i'd be happy if",
    "having got there", "having arrived", "the next job for", "the next task for", "next job for", "next task for",
    "the job for", "is to be", "ought to", "as a next step", "could you please",
)  # fmt: skip
"""Runs of words (ROBOT: a mention of robots) that may stand beside a plan without being in it."""
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
GUARDS = (NEGATIONS | CONDITIONS | EXCEPTIONS | ALTERNATIVES | CORRECTIONS | SEQUENCE | SIDE_BY_SIDE) - NOUNS_TOO
"""Words that no name of a thing or place accounts for."""
