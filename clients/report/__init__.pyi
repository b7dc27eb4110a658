from .facts import EyeFacts as EyeFacts
from .make import compute_eye_facts as compute_eye_facts
from .make import report_html as report_html
from .make import report_numbers as report_numbers
from .make import write_report as write_report
