/* CoDel, controlled delay (RFC 8289): drops packets while the queue's delay stays above a target.

   CoDel decides when a packet's service would begin. The bottleneck serves in the order of arrival,
   at a deterministic rate, so that this time, and hence the packet's time in the queue, is known on
   arrival. Therefore the control law is applied on arrival; it sees the same packets in the same
   order with the same times. A packet that it drops keeps its place in the queue until that time.
   In the RFC, an empty queue resets the law; here the next packet resets it, since it does not
   wait.

   One rule differs. The RFC does not drop a packet if at most one MTU waits behind it when it
   leaves the queue, which is not known on arrival. Here, a packet is not dropped if at most one MTU
   is before it when it arrives. The rules differ at the end of a burst: the RFC does not drop its
   last packets, this implementation may.

   If the law drops a packet that must pass, the packet is served, and the law's state does not
   change: it drops the next packet that need not pass. */
#include <math.h>

#include "../network/network.h"

/* The time at which the service of a newly arrived packet would begin: with a burst, the time from
   which the rate fills the bucket for it, or its arrival. */
static int64_t service_ns(const noack_stage_state *queue) {
    return max_of(queue->entry_ns, queue->busy_until_ns);
}

/* t + interval/sqrt(count) */
static int64_t control_law(const noack_bottleneck *settings, int64_t t_ns, int64_t drops) {
    return t_ns + (int64_t)((double)settings->interval_ns / sqrt((double)drops));
}

/* Whether the law drops the newly arrived packet. */
int codel_is_due(const noack_link *link, int64_t stage) {
    const noack_bottleneck *settings = &link->stages[stage].bottleneck;
    noack_stage_state *queue = &link->stage_states[stage];
    int64_t now_ns = service_ns(queue), sojourn_ns = now_ns - queue->entry_ns;
    int above_long_enough = 0;
    if (sojourn_ns < settings->target_ns || sojourn_ns <= settings->mtu_ns)
        queue->first_above_ns = 0;
    else if (queue->first_above_ns == 0)
        queue->first_above_ns = now_ns + settings->interval_ns;
    else
        above_long_enough = now_ns >= queue->first_above_ns;
    if (queue->dropped_before) {
        queue->dropped_before = 0;
        if (above_long_enough)
            queue->drop_next_ns = control_law(settings, queue->drop_next_ns, queue->drops);
    }
    if (!above_long_enough) {
        queue->dropping = 0;
        return 0;
    }
    return !queue->dropping || now_ns >= queue->drop_next_ns;
}

/* Drop the newly arrived packet: it keeps its place, and the law's state advances. */
void codel_drop(noack_link *link, int64_t stage, int64_t bytes) {
    const noack_bottleneck *settings = &link->stages[stage].bottleneck;
    noack_stage_state *queue = &link->stage_states[stage];
    int64_t now_ns = service_ns(queue);
    queue_occupy(link, stage, now_ns, bytes);
    if (queue->dropping) {
        queue->drops++;
        queue->dropped_before = 1;
        return;
    }
    int recent = now_ns - queue->drop_next_ns < 16 * settings->interval_ns;
    int64_t delta = queue->drops - queue->last_drops;
    queue->dropping = 1;
    queue->drops = delta > 1 && recent ? delta : 1;
    queue->last_drops = queue->drops;
    queue->drop_next_ns = control_law(settings, now_ns, queue->drops);
}
