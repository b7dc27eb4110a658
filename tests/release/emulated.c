/* Runs the library's functions for another process, which keeps the data.
 *
 * Started by emulated.py, under an emulator of another processor.  Both processes have
 * the same record layouts (little-endian, 64 bits).  An access to an address that is
 * not mapped here fetches the page from the other process; after each call, changed
 * words are sent back and the pages are dropped.
 *
 * In:  a call {function, library, address, integers, doubles}: a name is looked up in the
 *      library, otherwise the address is called; or the answer to a fetch
 * Out: {'F', address} fetch a page, {'S', address, length} and bytes store,
 *      {'R', result} the call has returned
 *
 * Integers and doubles are passed in registers of their own.  Of up to 16 integers, those
 * beyond the first eight are on the stack, in order, as there are at most eight doubles.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#define PAGE 4096
#define MAX_PAGES 65536

static struct { char *here; char was[PAGE]; } *pages;
static int page_count;

static void fail(const char *why) {
    fprintf(stderr, "emulated: %s\n", why);
    _exit(3);
}

static void get(void *to, size_t size) {
    for (char *at = to; size > 0;) {
        ssize_t n = read(0, at, size);
        if (n <= 0) _exit(0); /* the other process has ended */
        at += n;
        size -= (size_t)n;
    }
}

static void put(const void *from, size_t size) {
    for (const char *at = from; size > 0;) {
        ssize_t n = write(1, at, size);
        if (n <= 0) _exit(0);
        at += n;
        size -= (size_t)n;
    }
}

static void put_words(int64_t a, uint64_t b) {
    uint64_t words[2] = {(uint64_t)a, b};
    put(words, sizeof words);
}

static void fetch(int signal, siginfo_t *info, void *context) {
    (void)signal;
    (void)context;
    char *here = (char *)((uintptr_t)info->si_addr & ~(uintptr_t)(PAGE - 1));
    if (page_count == MAX_PAGES) fail("a call uses too many pages");
    if (mmap(here, PAGE, PROT_READ | PROT_WRITE,
             MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED_NOREPLACE, -1, 0) != here)
        fail("an address is in use here; run it again");
    put_words('F', (uintptr_t)here);
    uint64_t exists;
    get(&exists, sizeof exists);
    if (!exists) fail("the other process has no memory at an address");
    get(here, PAGE);
    pages[page_count].here = here;
    memcpy(pages[page_count].was, here, PAGE);
    ++page_count;
}

static void send_changes(void) {
    for (int i = 0; i < page_count; ++i) {
        char *here = pages[i].here;
        for (size_t first = 0; first < PAGE;) {
            if (!memcmp(here + first, pages[i].was + first, 8)) {
                first += 8;
                continue;
            }
            size_t end = first + 8;
            while (end < PAGE && memcmp(here + end, pages[i].was + end, 8)) end += 8;
            put_words('S', (uintptr_t)here + first);
            uint64_t length = end - first;
            put(&length, sizeof length);
            put(here + first, length);
            first = end;
        }
        munmap(here, PAGE);
    }
    page_count = 0;
}

#define MOST_LIBRARIES 4
typedef uint64_t word;
typedef word (*any_function)(word, word, word, word, word, word, word, word, double, double,
                             double, double, double, double, double, double, word, word,
                             word, word, word, word, word, word);

int main(int count, char **arguments) {
    void *libraries[MOST_LIBRARIES];
    if (count < 2 || count > MOST_LIBRARIES + 1) fail("expected libraries");
    for (int i = 1; i < count; ++i) {
        libraries[i - 1] = dlopen(arguments[i], RTLD_NOW);
        if (libraries[i - 1] == NULL) fail(dlerror());
    }
    pages = malloc(MAX_PAGES * sizeof *pages);
    struct sigaction action = {.sa_sigaction = fetch, .sa_flags = SA_SIGINFO | SA_NODEFER};
    sigaction(SIGSEGV, &action, NULL);
    for (;;) {
        struct { char name[32]; word library, address, v[16]; double d[8]; } call;
        get(&call, sizeof call);
        const word *v = call.v;
        const double *d = call.d;
        any_function function;
        void *at = (void *)call.address;
        if (call.name[0] != 0) at = dlsym(libraries[call.library], call.name);
        if (at == NULL) fail(call.name);
        *(void **)&function = at;
        word result = function(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], d[0], d[1], d[2],
                               d[3], d[4], d[5], d[6], d[7], v[8], v[9], v[10], v[11], v[12],
                               v[13], v[14], v[15]);
        if (!strcmp(call.name, "ocu_name")) memcpy(&result, (char *)result, sizeof result);
        send_changes();
        put_words('R', result);
    }
}
