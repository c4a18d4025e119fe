"""Lists of pairs of 3RScan and ScanNet: which recording is asked in which map."""
