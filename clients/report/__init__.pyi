from .facts import EyeFacts as EyeFacts
from .make import eyes_of as eyes_of
from .make import report_html as report_html
from .make import report_numbers as report_numbers
from .make import write_report as write_report
