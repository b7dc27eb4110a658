"""Reports of simulated eyes: `ocufilter report` and `report_html`.

program     the command
make        builds reports from profiles, and identifies them
facts       computed content of a report on one eye: numbers, letter charts, names
text        sentences: corrections, method, provenance, literature references
tables      tables of a report
plain       the first paragraph of a report on two eyes
content     the report of one eye
comparison  the report of two eyes
html_page   sections, rows, tables and figures, and their HTML, from which a PDF is
            printed
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
