"""The pages: what a run, a check or a calibration has to say, in one HTML file each."""
