"""Reading English: what both wings share of it, whatever it is that a text describes.

A text is refused or taken (`check`), cut into sentences of words and distances (`words`,
`measures`), grouped into phrases that a grammar knows (`phrases`), and parsed by islands
(`islands`), so that what is not understood is left out and told. The phrases, the grammar and what
they mean are each wing's own: streets and compasses outdoors, furniture and one's left indoors.
"""
