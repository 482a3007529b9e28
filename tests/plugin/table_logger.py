import csv

from msk_ray import Logger


class Table(Logger):
    """The score at each evaluation, in a file that spreadsheets read."""

    def write(self, row):
        if "eval/score" in row:
            with (self.folder / "scores.csv").open("a", newline="") as file:
                csv.writer(file).writerow([row["epoch"], row["eval/score"]])
