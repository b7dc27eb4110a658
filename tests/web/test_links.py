"""Links: opened first, edited in an open page, copied, and followed from elsewhere."""

import base64
import http.server
import json
import threading

from tests.web.browser import PageUnderTest


def _fragment(**entries):
    text = json.dumps({"v": 1, **entries}).encode()
    return base64.urlsafe_b64encode(text).decode().rstrip("=")


SPHERE = {"OD": {"texts": {"sphere_dpt": "-3.50"}}}


def _opened(context, address):
    page = PageUnderTest(context.new_page())
    page.open(address)
    return page


def test_a_link_with_its_token_opens_with_its_entries(browser, address):
    context = browser.new_context()
    tab = context.new_page()

    def slow(route):  # a first visit loads more than the page's first change takes
        tab.wait_for_timeout(1500)
        route.continue_()

    tab.route("**/socket.io*.js", slow)
    page = PageUnderTest(tab)
    page.open(f"{address}#{_fragment(eyes=SPHERE, scene='chart')}")
    page.page.get_by_role("button", name="Letter chart", pressed=True).wait_for()
    assert page.entry("sphere_dpt").input_value() == "-3.50"
    assert "token" not in page.page.url
    context.close()


def test_a_fragment_edited_in_the_open_page_is_taken(page):
    number = page.number()
    page.page.evaluate("f => { location.hash = f; }", _fragment(eyes=SPHERE))
    page.settle(after=number)
    assert page.entry("sphere_dpt").input_value() == "-3.50"
    number = page.number()
    page.page.evaluate(
        "f => { location.hash = f; }", _fragment(values={"pupil_diameter_mm": 6.0})
    )
    page.settle(after=number)
    assert page.slider("pupil_diameter_mm").input_value() == "6"
    assert page.entry("sphere_dpt").input_value() == "0.00"
    page.page.evaluate("location.hash = 'e30'")
    page.page.get_by_text("The link contains no entries for this page").wait_for()
    assert page.slider("pupil_diameter_mm").input_value() == "6"


def test_a_copied_link_works_in_another_browser(browser, address):
    context = browser.new_context()
    context.grant_permissions(["clipboard-read", "clipboard-write"])
    page = _opened(context, address)
    number = page.number()
    page.entry("sphere_dpt").fill("-3.5")
    page.settle(after=number)
    page.choose("Copy link")
    page.page.get_by_text("Anyone who has it can use this page").wait_for()
    link = page.page.evaluate("navigator.clipboard.readText()")
    assert link.startswith(address + "#")
    context.close()
    context = browser.new_context()
    other = _opened(context, link)
    assert float(other.entry("sphere_dpt").input_value()) == -3.5
    context.close()


def test_a_link_on_another_site_opens_the_page(browser, address):
    link = f"{address}#{_fragment(eyes=SPHERE)}"
    html = f'<a href="{link}">the eye</a>'.encode()

    class Site(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("content-type", "text/html")
            self.end_headers()
            self.wfile.write(html)

        def log_message(self, *args):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Site) as site:
        thread = threading.Thread(target=site.serve_forever)
        thread.start()
        context = browser.new_context()
        try:
            page = PageUnderTest(context.new_page())
            page.page.goto(f"http://localhost:{site.server_port}/")  # another site
            page.page.get_by_text("the eye").click()
            page.settle()
            assert page.entry("sphere_dpt").input_value() == "-3.50"
        finally:
            context.close()
            site.shutdown()
            thread.join()
