"""The tables of the SG2Loc paper, on a user's 3RScan and ScanNet and on what this project has."""
