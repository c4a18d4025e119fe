"""Reading text, as far as both wings do it alike.

A text is refused or taken, and cut into sentences of words and phrases (`text`) and distances
(`measures`). Phrases become chunks, which a grammar parses by islands into clauses of noun and place
phrases (`grammar`); what is not understood is left out and reported. The phrases, the grammar and
their meaning are each wing's own: streets and compasses outdoors, furniture and one's left indoors.
"""
