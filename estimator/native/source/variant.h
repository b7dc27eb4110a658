/* Functions that Python calls by name, compiled once for each kind of processor. */
#ifndef OCU_VARIANT_H
#define OCU_VARIANT_H

/* Changes with the meaning of what libraries exchange: pool.h. */
#define OCU_ABI 1

typedef void (*any_function)(void);

typedef struct {
    const char *name;
    any_function function;
} named_function;

#define FUNCTION(name) {#name, (any_function)(name)}

typedef struct {
    const char *name;
    const named_function *functions; /* the last has no name */
} variant;

#endif
