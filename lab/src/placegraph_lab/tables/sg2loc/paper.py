"""What the tables of the SG2Loc paper say, as printed: of its own method, and of HLoc beside it.

Errors are in metres and degrees, recalls are shares. Sequence lengths are set off by bars.
"""

_PRINTED = """
1; 3RScan: HLoc; 2.05e12 46.68 .18 6.32 | 5.1e10 36.85 .13 4.15 | 1030.9 22.74 .08 2.44 | 732.2 16.09 .07 2.06
1; 3RScan: SG2Loc; 2.43 21.24 .20 3.27 | 2.30 20.50 .18 2.96 | 6.15 22.93 .14 2.73 | 9.48 27.43 .10 2.62
1; ScanNet: HLoc; 6.16e4 14.30 .09 2.63 | 603.05 10.48 .08 2.45 | 492.00 7.27 .06 2.12 | 1348.28 7.12 .07 1.94
1; ScanNet: SG2Loc; .53 11.55 .12 2.55 | .44 8.14 .10 2.30 | .32 4.55 .09 2.29 | 2.10 12.27 .08 1.70
2; 3RScan: HLoc; .54 .28 .27 | .62 .32 .32 | .74 .43 .43 | .76 .50 .50
2; 3RScan: SG2Loc; .53 .38 .32 | .55 .38 .33 | .59 .43 .39 | .65 .43 .43
2; ScanNet: HLoc; .81 .38 .38 | .86 .41 .41 | .91 .47 .47 | .98 .52 .52
2; ScanNet: SG2Loc; .73 .40 .36 | .80 .40 .39 | .86 .43 .42 | .90 .61 .61
3; HLoc, 3RScan and ScanNet; 294.4 283.3
3; SG2Loc, 3RScan and ScanNet; 9.8 28.2
4; 3RScan: HLoc; 3520.0 .01 -
4; 3RScan: SG2Loc; 1.6 2.90 5.5
6; 3RScan: HLoc; .94 33.99 .27 3.67 .48 .35 .35
6; 3RScan: SG2Loc w/ keyframing; 2.36 20.08 .18 2.75 .54 .43 .40
7; 3RScan: Max. raycast resolution; .07 .33
7; 3RScan: Uniform sampling; .10 .30
7; 3RScan: w/o adaptive resampling; .11 .30
7; 3RScan: SG2Loc w/ semantic; .11 .35
7; 3RScan: SG2Loc w/ semantic+depth; .20 .54
7; 3RScan: SG2Loc w/ semantic+depth+RGB; .35 .61
7; 3RScan: SG2Loc; .50 .65
8; 3RScan: SG2Loc w/ semantic; 1.20 21.44 .66 8.77 .08 .26
8; 3RScan: SG2Loc w/ depth; 1.44 39.01 .96 6.42 .09 .32
8; 3RScan: SG2Loc w/ RGB; 1.79 44.78 1.51 17.37 .14 .20
9; ScanNet: SG2Loc w/ semantic; 1.08 21.21 .73 7.40 | 1.00 18.55 .57 6.28 | .86 15.69 .43 5.95
9; ScanNet: SG2Loc w/ semantic+depth+RGB; .56 11.92 .15 2.45 | .54 10.23 .14 2.08 | .46 10.42 .13 1.99
9; ScanNet: SG2Loc; .53 11.55 .12 2.55 | .44 8.14 .10 2.30 | .29 4.55 .09 2.29
10; ScanNet: SG2Loc w/ semantic; .12 .33 | .12 .34 | .14 .40
10; ScanNet: SG2Loc w/ semantic+depth+RGB; .26 .69 | .28 .73 | .32 .75
10; ScanNet: SG2Loc; .41 .72 | .49 .79 | .58 .80
11; ScanNet: SGL, one frame; .924 - - - - - -
11; ScanNet: Seq. SGL; .951 - - - - - -
11; ScanNet: SG2Loc; .857 .24 7.21 .16 2.25 .33 .80
12; 3RScan: HLoc; 2.05e12 46.68 .18 6.32 | 1030.90 22.74 .08 2.44
12; 3RScan: SG2Loc; 2.43 21.24 .20 3.27 | 6.15 22.93 .14 2.73
12; 3RScan: SG2Loc (Coarse); 2.25 24.37 .31 5.05 | 8.08 27.10 .14 3.44
13; 3RScan: HLoc; .54 .28 .27 | .74 .43 .43
13; 3RScan: SG2Loc; .53 .38 .32 | .59 .43 .39
13; 3RScan: SG2Loc (Coarse); .46 .31 .27 | .58 .38 .36
14; ScanNet: HLoc; .09 2.63 .38
14; ScanNet: HLoc w/ SLAM poses; .15 2.67 .34
14; ScanNet: SG2Loc; .12 2.55 .36
14; ScanNet: SG2Loc w/ SLAM poses; .16 2.63 .36
"""
"""Number of a table, row, figures by sequence length; table 5 stands in `retrieval_report.PAPER`."""


def figures(table: int) -> list[tuple[str, list[list[float | None]]]]:
    """Rows of a table: name, and figures by sequence length; None where there is none."""
    lines = [line.split(";") for line in _PRINTED.strip().splitlines()]
    return [
        (
            row.strip(),
            [[None if w == "-" else float(w) for w in p.split()] for p in text.split("|")],
        )
        for of, row, text in lines
        if int(of) == table
    ]
