"""A dialogue: ask back until one place is left. The answers of a person stand in `knows`."""

import sys
from pathlib import Path

import placegraph as pg

world = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out/world")  # left by `placegraph demo`
city = pg.open_map(world / "hafenstadt.city")  # made by 01_sentence_to_place.py

said = "I am standing on a square. There is a fountain north of me and a café to my east."
knows = {"Fischmarkt", "yes"}  # what the person would answer
answers = []
estimate = city.locate(said)
while estimate.status is pg.Status.AMBIGUOUS:
    question = estimate.next_question(city)
    if question is None:
        break  # nothing on the map would tell the places apart
    choice = next((o for o in question.options if o in knows), question.options[-1])
    print(f"{question.text} {list(question.options)} -> {choice}")
    answers.append(question.answer(choice))
    estimate = city.locate(said, answers=answers)
print(f"{estimate.status}: {estimate.best.latitude:.5f} N, {estimate.best.longitude:.5f} E")
