"""Reports of simulated eyes: `ocufilter report` and `report_html`.

program          the command
make             reports from profiles
facts            computed content of a report on one eye
numbers          numbers of a report
correction_text  descriptions of corrections
charts           filtered letter charts, near and far
method_text      how the eye was computed
provenance       measured, entered and assumed data
sources          literature references
labels           names of the eyes
origin           reference, date, version and digest of the profile
blocks           sections, rows, tables and figures
tables           tables of a report
content          the report of one eye
comparison       the report of two eyes
html_page        HTML output, which a PDF is printed from
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
