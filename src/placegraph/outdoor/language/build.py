"""Descriptions: a text becomes sentences, these clauses, and these a query graph (Eq. 3-4)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from placegraph.language.grammar import Chunk, Clause, PlacePhrase
from placegraph.language.text import IgnoredText, check_text
from placegraph.outdoor.language.chunks import find_sentences
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Mention,
    Relation,
    ends,
    find_conflicts,
)
from placegraph.outdoor.language.grammar import Item, Items, NounPhrase, Place, cut_clauses, parser
from placegraph.outdoor.language.languages import Language
from placegraph.outdoor.language.scan import clean, find_stretches
from placegraph.outdoor.language.statements import (
    NO_MAP,
    NO_PLACE,
    UNKNOWN,
    BlockLength,
    ClauseContext,
    PlaceReader,
    References,
)
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.language.walk import Walk
from placegraph.outdoor.language.words import ROADS, NameFinder, normalise, tokens

MENTIONED = 0.7
"""Certainty that a thing is in sight that is only named."""
LED = 0.5
"""Certainty that the place is where the walk leads."""
SHOWN = 0.6
"""Certainty that what "you will see" can be seen from the place itself."""
NO_LANGUAGE = "in an unknown language"
"""Reason of a sentence that may mean something else."""


_SUFFIX, _LABEL = re.compile(r"['’]\w+"), re.compile(r"\S*[=_]\S*")


def describe(
    text: str,
    *,
    vocabulary: Vocabulary | None = None,
    names: NameFinder | None = None,
    heading: float | None = None,
    language: str | None = None,
    block_length: BlockLength | None = None,
    grammar: bool = True,
) -> Description:
    """Read a text: what stands where, as seen from whom.

    Parameters
    ----------
    text
        Sentences of one or more of the languages that can be read (`languages.codes`). In English
        ones, the words for things may be of any language of the vocabulary.
    vocabulary
        What words may mean on a map; the one that comes with placegraph if None.
    names
        Proper names of a map.
    heading
        Bearing in which the speaker faces [rad, clockwise from north], for "left of me".
    block_length
        Length of a block [m] in the direction of a bearing [rad], or in any (None), on the map at
        hand; 100 m if not given.
    language
        Code of the language of the text ("de"); if None, it is recognised, sentence by sentence.
    grammar
        False to read names and kinds of things alone, in any order; so are languages whose table
        says ``grammar = false``.

    Raises
    ------
    OptionError
        If there is no such language; lists those that there are.
    DescriptionError
        If the text is empty, too long, or no text. A text of which nothing is understood is no
        error: it gives a description without statements.
    """
    check_text(text)
    vocabulary = vocabulary or Vocabulary.default()
    cleaned, sources = clean(text), vocabulary.sources
    parts = find_stretches(cleaned, language, sources.folder, sources.words.english)
    sites = names.find_sites(cleaned) if names else []
    sentences = [
        (sentence, part.language)
        for part in parts
        for sentence in find_sentences(cleaned, part, vocabulary, names, sites)
    ]
    main = max(parts, key=lambda part: part.end - part.start)
    directive = any(_is_directive(sentence) for sentence, _ in sentences)
    references = References(
        cleaned, main.language, vocabulary, {cleaned[start:end] for start, end in sites}
    )
    places = PlaceReader(references, heading, directive=directive, block_length=block_length)
    builder = GraphBuilder(places)
    for sentence, spoken in sentences:
        if grammar and spoken.grammar:
            _read_sentence(sentence, spoken, builder)
        if spoken.code != "en" or not grammar:
            builder.note(sentence, grammar=grammar and spoken.grammar)
    for part in parts:
        if names and (part.language.code != "en" or not part.certain):
            builder.complete(cleaned[part.start : part.end], part.language, names)
    builder.finish()
    statements, ignored = places.statements, [*places.ignored, *references.list_unknown()]
    if not (statements or ignored):
        ignored.append(IgnoredText(text.strip(), NO_PLACE))
    unsure = [part for part in parts if statements and not part.certain]
    ignored += [IgnoredText(cleaned[p.start : p.end].strip(), NO_LANGUAGE) for p in unsure]
    conflicts = find_conflicts(statements, references.heads, places.goals, references.kinds)
    return Description(
        text,
        tuple(references.mentions),
        tuple(statements),
        tuple(ignored),
        conflicts,
        main.language.code if main.certain else "",
    )


def _read_sentence(sentence: list[Chunk], language: Language, builder: GraphBuilder) -> None:
    """Add what a sentence says."""
    for part in cut_clauses(sentence, language):
        opens = part.opens
        for clause, left_out in parser().parse(part.chunks):
            builder.take(clause, part.certainty, opens=opens)
            opens = False
            for chunk in left_out:
                if clause.verb and chunk.type == "WORD":
                    builder.ignored.append(IgnoredText(chunk.words, "unknown word"))


def _is_directive(sentence: list[Chunk]) -> bool:
    """Tell whether a sentence speaks to somebody who is to come."""
    orders = ("GO", "PASS", "CROSS", "FOLLOW", "MEET")
    return any(chunk.type in ("YOU", "YOUR", "MEET") for chunk in sentence) or (
        bool(sentence) and sentence[0].type in orders
    )


class GraphBuilder:
    """Adds the clauses of a text, one after the other, to the statements of its places.

    Where the text tells somebody the way (`PlaceReader.directive`), "it" is the place to find.
    """

    def __init__(self, places: PlaceReader) -> None:
        self.places, self.references = places, places.references
        self.directive, self.ignored = places.directive, places.ignored
        self.walk = Walk(places)
        self.heads: list[int] = [SPEAKER]
        """Nodes that the last clause spoke of."""
        self.walking = False
        """Whether the last clause led somewhere."""

    def take(self, clause: Clause, certainty: float, *, opens: bool) -> None:
        """Add what a clause says; `opens` tells whether it opens a sentence."""
        words = self.references.text[clause.start : clause.end]
        context = ClauseContext(words, certainty, clause.negated, walked=self.walk.legs > 0)
        before, first = [*self.places.statements], len(self.places.statements)
        unread = len(self.ignored)
        self.places.reason = NO_PLACE
        if clause.condition and clause.verb != "meets":  # "when you see the bank"
            self.walk.go(clause.after or clause.before, clause.travel or "REACH", context)
        elif clause.verb:
            getattr(self, f"_{clause.verb}")(clause, context, opens)
            if clause.verb != "goes":
                self.walk.join(first)
        else:
            self.places.reason = "not understood"
        said = self.places.statements != before or len(self.ignored) > unread
        if not said and clause.verb != "too_far":
            self.ignored.append(IgnoredText(words, self.places.reason))
        self.walking = clause.verb == "goes" or (self.walking and clause.verb == "fragment")
        self._choose_topic()

    def note(self, sentence: list[Chunk], *, grammar: bool) -> None:
        """Let the place be near names of the map that no statement speaks of.

        Without grammar these are all names, and kinds of things are in sight.
        """
        for chunk in sentence:
            named = chunk.type == "NAME" and chunk.value.exact
            if not named and (grammar or chunk.type not in ("NAME", "NOUN")):
                continue
            noun = NounPhrase(
                "thing", chunk.start, chunk.end, "DET", senses=chunk.value.senses,
                head=chunk.words, name=chunk.value.name,
            )  # fmt: skip
            node = self.references.resolve(noun)
            if node is None or any(
                SPEAKER in ends(s) and node in (*ends(s), s.target2)
                for s in self.places.statements
                if s.relation is not Relation.BETWEEN
            ):
                continue
            context = ClauseContext(self.references.text[chunk.start : chunk.end])
            if noun.name:
                self.places.add(context, Relation.NEAR, SPEAKER, node, certainty=LED)
            else:
                self.places.add(context, Relation.VISIBLE, node, SPEAKER, certainty=MENTIONED)

    def complete(self, text: str, language: Language, names: NameFinder) -> None:
        """Give mentions the names of the map that their words begin with: "Kauppatoria".

        The place is near what no mention speaks of: "Marktplatzbrunnen", names in an unknown language.
        """
        vocabulary, mentions = self.references.vocabulary, self.references.mentions
        known = vocabulary if language.code == "en" else vocabulary.of(language)
        lists = language.lists
        prefixes = lists.get("street_prefixes", ROADS) | lists.get("place_prefixes", ROADS)
        roads = lists["street_suffixes"] | lists["road_words"] | ROADS
        text = _LABEL.sub(",", text)
        found = [*names.find_within(text), *names.find_within(_SUFFIX.sub(" ", text))]
        for name, rest in dict.fromkeys(found):
            node = next((m.id for m in mentions[2:] if name in normalise(m.words)), len(mentions))
            if node == len(mentions):
                common = known.senses(name) or name in language.words
            else:
                told = mentions[node]
                capital = language.capitals and told.words[0].isupper()
                common = told.senses and not (told.name or capital)
            site = node < len(mentions) and mentions[node].name in self.references.sites
            if common or site or rest in roads:
                continue
            if len(rest) > min(3, len(name) // 3) and not known.senses(rest):
                continue
            if node == len(mentions):
                mentions.append(Mention(node, name))
                self.references.heads.append("")
                self.references.modifiers.append(frozenset())
            words = tokens(mentions[node].name)
            exact = bool(words) and names.longest_name(words, 0) == len(words)
            if not (words and (exact or {*words} - {*name.split()} <= prefixes)):
                mentions[node] = replace(mentions[node], name=name)
            if not any(node in (s.source, s.target, s.target2) for s in self.places.statements):
                self.places.add(ClauseContext(name), Relation.NEAR, SPEAKER, node, certainty=LED)

    def finish(self) -> None:
        """Let a walk lead to the speaker where nothing says where the speaker is."""
        led_to = self.walk.led_to
        if self.directive and led_to is not None and self.places.goals == {SPEAKER}:
            context = ClauseContext(self.references.mentions[led_to].words)
            self.places.add(context, Relation.SAME, SPEAKER, led_to, certainty=LED)
            self.places.goals.add(led_to)

    def _choose_topic(self) -> None:
        """Decide what "it" will mean in the next clause."""
        goal = [n for n in self.places.goals if n != SPEAKER]
        if self.directive:
            self.references.topic = max(goal, default=self.walk.led_to)
        elif self.heads and self.heads[0] > LISTENER:
            self.references.topic = self.heads[0]
        elif goal:
            self.references.topic = max(goal)
        elif len(self.references.mentions) > 2:
            self.references.topic = len(self.references.mentions) - 1

    # clauses, by the rules of the grammar

    def _is_(self, clause: Clause, context: ClauseContext, _opens: bool) -> None:
        """Read "the bakery is north of me", "north of here is a bakery"."""
        before, after = clause.before, clause.after
        if isinstance(before[0], PlacePhrase):
            if after and isinstance(after[0], NounPhrase):
                self._show(_places_behind(before, after), context)
            else:
                self._relate_chain((*before, *after), [SPEAKER], context)
            return
        heads = self._relate_chain(before, [], replace(context, negated=False))
        after = _lead_part(after)  # "it is the foot of Davie Street"
        if after and isinstance(after[0], NounPhrase):
            self._identify(heads, after[0], context)
            after = after[1:]
            self._relate_chain(after, heads, context)
        elif after:
            self._relate_chain(after, heads, context)

    def _identify(self, heads: Sequence[int], noun: NounPhrase, context: ClauseContext) -> None:
        """Relate two names of one thing: "it is the last pub on the block"."""
        if noun.kind != "thing" or not (noun.senses or noun.name) or not heads:
            return
        bare = not noun.determiner and bool(self.references.lists["articles"])
        if heads[0] == SPEAKER and bare and not noun.name:
            return  # "I'm buying flowers"
        node, subject = self.references.resolve(noun), heads[0]
        if node is None or node == subject:
            return
        if subject > LISTENER and not self.references.is_known(subject):  # "the nearest one is ..."
            self.places.add(context, Relation.VISIBLE, node, SPEAKER)
            return
        if subject == SPEAKER and noun.name and self.references.language.code != "en":
            self.places.add(context, Relation.ALONG, subject, node)  # "bin an der Halde", a street
            return
        self.places.add(context, Relation.SAME, subject, node)
        if subject in self.places.goals and not context.negated:
            self.places.goals.add(node)

    def _exists(self, clause: Clause, context: ClauseContext, _opens: bool) -> None:
        """Read "to the north there is a park", "I have a bar to my right"."""
        places: Items = clause.before
        if places and _is_person(places[-1]):
            if any(isinstance(item, PlacePhrase) for item in clause.after):
                # "facing north, I have a bar to my right"
                self._relate_chain(places[:-1], [SPEAKER], context)
                places = ()
            places = places[:-1]  # "to my right I have a bar"
        owner = places[0] if places else None
        if isinstance(owner, NounPhrase):
            places = clause.before[1:]
            shown = clause.after and isinstance(clause.after[0], NounPhrase)
            if owner.kind == "thing" and shown:  # "the street has a bakery"
                if not self.directive:
                    self.references.topic = self.references.resolve(owner)
                places = (*places, PlacePhrase("at", owner.start, owner.end, (owner,), "TO"))
        self._show(_places_behind(places, clause.after), context)

    def _show(self, items: Items, context: ClauseContext, *, always: bool = False) -> None:
        """Relate things that are there, in sight of the speaker unless more is said."""
        first = len(self.places.statements)
        heads = self._relate_chain(items, [], context, collect=True)
        placed = {
            s.source
            for s in self.places.statements[first:]
            if not always or SPEAKER in (s.source, s.target)
        }
        for head in heads:
            if head not in placed and self.references.is_known(head):
                self.places.add(context, Relation.VISIBLE, head, SPEAKER)
            elif head not in placed:
                self.places.reason = UNKNOWN

    def _sees(self, clause: Clause, context: ClauseContext, opens: bool) -> None:
        """Read "I see a church", "across the street you will find a bakery"."""
        things = [item for item in clause.before if isinstance(item, NounPhrase)]
        seer = things[-1] if things else None
        places = tuple([item for item in clause.before if item is not seer])
        after = clause.after
        if after and isinstance(after[0], NounPhrase) and after[0].kind == "ME":
            self._meets(clause, context, opens)  # "you will find me at the corner"
            return
        mine = seer is not None and seer.kind == "ME"
        placed = any(isinstance(item, PlacePhrase) for item in (*places, *after))
        sure = 1.0 if mine else 0.9 if placed else SHOWN
        context = replace(context, certainty=context.certainty * sure)
        self._show(_places_behind(places, after), context, always=mine)

    def _meets(self, clause: Clause, context: ClauseContext, _opens: bool) -> None:
        """Read "meet me at the garden"."""
        places = tuple([item for item in (*clause.before, *clause.after) if not _is_person(item)])
        if not places:  # "you will see a bank. Meet me there."
            if self.heads and self.heads[0] > LISTENER:
                self.walk.led_to = self.heads[0]
            self.finish()
            return
        first = places[0]
        if isinstance(first, NounPhrase):  # "meet me the garden"
            first = PlacePhrase("at", first.start, first.end, (first,), "AT")
        self._relate_chain((first, *places[1:]), [SPEAKER], context)

    def _goes(self, clause: Clause, context: ClauseContext, _opens: bool) -> None:
        """Read "head north past the bank", "the road runs along a river"."""
        subject = clause.before[0] if clause.before else None
        if isinstance(subject, NounPhrase) and subject.kind in ("thing", "IT", "SPOT"):
            heads = self._relate_chain(clause.before, [], context)
            weaker = replace(context, certainty=context.certainty * 0.7)
            self._relate_chain(clause.after, heads, weaker)
            return
        places = [item for item in clause.before if isinstance(item, PlacePhrase)]
        self.walk.go((*places, *clause.after), clause.travel, context)
        if clause.travel == "REACH":  # "get to the entrance"
            self.walk.led_to = self.walk.on_the_way

    def _too_far(self, clause: Clause, context: ClauseContext, _opens: bool) -> None:
        self.walk.look_back(clause.after, context)

    def _fragment(self, clause: Clause, context: ClauseContext, opens: bool) -> None:
        """Read "a bakery north of me", "no trees here", "then west"."""
        items = _lead_part(clause.before)
        first, alone = items[0], len(items) == 1
        if isinstance(first, PlacePhrase):
            leg = first.distance is not None and first.how in ("towards", "away")
            further = bool(self.walk.way.statements) and leg and not first.targets
            if (self.walking or further) and not opens:  # "then west"
                self.walk.go(items, "GO", context)
            else:  # "..., but not near the church"
                self._relate_chain(items, [SPEAKER] if opens else self.heads, context)
        elif all(_is_person(item) for item in items):
            self.places.reason = NO_PLACE
        elif alone and first.name and not (first.senses or first.exact or " " in first.name):
            self.places.reason = UNKNOWN  # "Hello", "Qué": a capital alone makes no name
        else:
            bare = alone and first.determiner != "NO"
            sure = (LED if self.directive else MENTIONED) if bare else 1.0
            self._show(items, replace(context, certainty=context.certainty * sure))

    # the chain of things and places

    def _relate_chain(
        self, items: Items, heads: Sequence[int], context: ClauseContext, *, collect: bool = False
    ) -> list[int]:
        """Relate places to the things before them; return the things.

        A thing without a place of its own joins the target before it ("north of the school and the
        church"); one with a place is spoken of anew ("a bakery to my east and a stop across ...").
        """
        group, spoken = list(heads), list(heads)
        last: Place | None = None
        for i, item in enumerate(items):
            following = items[i + 1] if i + 1 < len(items) else None
            if isinstance(item, PlacePhrase):
                context.shared = _find_shared_target(item, last, following)
                group = self._relate_all(item, group or [SPEAKER], context)
                last = item
            elif last is not None and _joins_targets(last, item, heads, following):
                again = replace(last, targets=(*last.targets[:-1], item))
                self._relate_all(again, group, context)
            elif (node := self.references.resolve(item)) is None:
                self.places.reason = NO_MAP if item.part else UNKNOWN
            else:
                if spoken and not self.directive:
                    self.references.topic = spoken[-1]  # "a bakery ..., and a kiosk next to it"
                group = [*group, node] if last is None and i else [node]
                spoken.append(node)
                last = None
        self.heads = spoken if collect or len(spoken) <= 1 else spoken[:1]
        return spoken if collect or not group or group[0] in spoken else group

    def _relate_all(self, place: Place, group: Sequence[int], context: ClauseContext) -> list[int]:
        nodes = [self.places.relate(place, head, context) for head in group]
        return [node for node in nodes if node is not None]


def _lead_part(items: Items) -> Items:
    """Take "front of the pool" as a place, where no word before it says so."""
    part, place = items[0] if items else None, items[1] if len(items) > 1 else None
    whole = isinstance(place, PlacePhrase) and place.how == "of" and place.targets
    if not (isinstance(part, NounPhrase) and part.part and not part.name and whole):
        return items
    return (PlacePhrase("at", part.start, whole[0].end, (part, *whole), "AT"), *items[2:])


def _places_behind(places: Items, after: Items) -> Items:
    """Put places before a verb behind the things after it: "south of me are a school and a park"."""
    n = next((i for i, item in enumerate(after) if isinstance(item, PlacePhrase)), len(after))
    return (*after[:n], *places, *after[n:])


def _joins_targets(
    last: Place, noun: NounPhrase, heads: Sequence[int], following: Item | None
) -> bool:
    """Tell whether a thing after a place is one more of its targets."""
    mine = isinstance(following, PlacePhrase) and (
        following.owner == "MY" or any(target.kind == "ME" for target in following.targets)
    )
    listed = not mine and (bool(heads) or not isinstance(following, PlacePhrase))
    things = bool(last.targets) and last.targets[-1].kind == noun.kind == "thing"
    return listed and things and last.how != "between"


def _find_shared_target(
    item: Place, last: Place | None, following: Item | None
) -> NounPhrase | None:
    """Return the target of the direction beside one that names none, or of "..., across the street"."""
    if item.how == "across" and len(item.targets) < 2 and last is not None and last.targets:
        return last.targets[-1] if last.how in ("towards", "prep") else None
    if item.how != "towards" or item.targets:
        return None
    for other in (following, last):
        if isinstance(other, PlacePhrase) and other.targets and other.how in ("towards", "start"):
            return other.targets[0]
        if isinstance(other, PlacePhrase) and other.how == "across" and len(other.targets) == 2:
            return other.targets[1]
    return None


def _is_person(item: Item) -> bool:
    """Tell whether an item is no thing of the map: somebody, "it", "here"."""
    return isinstance(item, NounPhrase) and item.kind != "thing"
