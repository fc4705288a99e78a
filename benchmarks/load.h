/* What relay_load.py uses of load.c; cffi reads it, too. */

struct burst {
    int64_t wall_ns;  /* from the relay's continuation to the last arrival */
    int64_t last;     /* highest number that arrived, -1 if none */
    int64_t received; /* number of arrivals */
};

int load_burst(
    int out, int sink, int64_t first, int64_t count, int relay, const uint32_t *sources,
    int64_t n_sources, int64_t slack, struct burst *found);
int load_ping(int out, int sink, int64_t first, int64_t count, int64_t *delay_ns);
int load_pace(
    int out, int sink, int64_t first, int64_t count, int64_t period_ns, int64_t *delay_ns);
