"""Reports of eyes, for those who judge a simulation: `ocufilter report`, `report_html`.

program     the command
make        from profiles to a report
facts       what is told of one eye, computed
numbers     its numbers
worn_words  what is worn
charts      the letter chart near and far
provenance  what was measured, what is assumed
sources     papers
blocks      what a report is made of
tables      of a report
content     the report of one eye
comparison  of two
html_page   written as one HTML file
pdf_pages   written as a PDF
pdf_text    its lines of text
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
