"""An experiment's and a trial's files on disk: what each is called, how it is written and how it is read back, whatever
its condition. No Ray, no torch."""
