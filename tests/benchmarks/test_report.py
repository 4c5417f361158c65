"""Pages of the benchmarks stand alone."""

import re

import matplotlib.pyplot as plt
import numpy as np

from benchmarks import report


def test_a_page_refers_to_nothing_outside_itself():
    figure, axes = plt.subplots()
    axes.plot([0, 1])
    parts = [
        report.html_text("A & B", "h2"),
        report.html_figure(figure, "a line"),
        report.html_figure(np.zeros((4, 4, 3), np.uint8), "a picture"),
        report.html_table(("What", "Value"), [(("x < y", "1"), True)]),
    ]
    assert figure.number not in plt.get_fignums(), "an embedded figure is closed"
    text = report.html_page("T", parts)
    assert all(source.startswith("data:image/png;base64,") for source in re.findall(r'src="([^"]*)"', text))
    assert "http" not in text
    assert "A &amp; B" in text
    assert "x &lt; y" in text
    assert '<tr class="missed">' in text
