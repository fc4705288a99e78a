/* The tags of the datagrams that the live driver sends and receives, four at once if they have one
   size and the processor has AVX2, as noack_exact_instructions() says. */
#include "driver.h"

#include <string.h>

#include "../exact/exact.h"

static int can_tag_four(int64_t content_bytes) {
    return noack_exact_instructions() > 0 && content_bytes % 8 == 0
           && is_between(NOACK_HEADER_BYTES, content_bytes, MOST_TAGGED_BYTES);
}

void write_tags(noack_driver *driver) {
    driver_scratch *scratch = scratch_of(driver);
    uint64_t tags[FOUR][NOACK_TAG_BYTES / 8];
    uint8_t *four[FOUR];
    for (int64_t k = 0, count; k < scratch->out_count; k += count) {
        const struct iovec *first = &scratch->out_vectors[k];
        int64_t content_bytes = (int64_t)first->iov_len - NOACK_TAG_BYTES;
        for (count = 0; count < FOUR && k + count < scratch->out_count
                        && first[count].iov_len == first->iov_len;
             count++)
            four[count] = scratch->out_data[k + count];
        if (count == FOUR && can_tag_four(content_bytes)) {
            tag_four(&driver->wire, content_bytes, four, tags);
            for (int lane = 0; lane < FOUR; lane++)
                memcpy(four[lane] + content_bytes, tags[lane], NOACK_TAG_BYTES);
        } else {
            write_tag(&driver->wire, content_bytes, four[0]);
            count = 1;
        }
    }
}

void compare_tags(noack_driver *driver) {
    driver_scratch *scratch = scratch_of(driver);
    uint64_t tags[FOUR][NOACK_TAG_BYTES / 8];
    uint8_t *four[FOUR];
    for (int64_t k = 0, count; k + FOUR <= scratch->in_end; k += count) {
        arrival *first = &scratch->arrivals[k];
        int64_t content_bytes = first->size_bytes - NOACK_TAG_BYTES;
        for (count = 0; count < FOUR && first[count].size_bytes == first->size_bytes; count++)
            four[count] = first[count].data;
        if (count < FOUR || !can_tag_four(content_bytes))
            continue;
        tag_four(&driver->wire, content_bytes, four, tags);
        for (int lane = 0; lane < FOUR; lane++)
            first[lane].has_tag = is_tag(tags[lane], four[lane] + content_bytes);
    }
}
