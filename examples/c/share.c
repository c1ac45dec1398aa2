/* Two processes: one renders splats into images that the other one reads, without a copy through the host.
 *
 *   cc -std=c99 share.c $(pkg-config --cflags --libs nightsplat vulkan) -o share
 *   ./share MODEL.ply [FRAMES [LAST]]        the reader leaves after frame LAST
 *
 * The library needs no function for this: an image with exportable memory is an image. The renderer keeps a ring of
 * three, and renders into those that the reader has given back. After a frame it releases the image to
 * VK_QUEUE_FAMILY_EXTERNAL, from which the reader acquires it. What orders the two is the renderer's timeline semaphore
 * where the driver exports it; otherwise the renderer waits for the frame and then tells of it.
 */
#define _POSIX_C_SOURCE 200809L
#include "gpu.h"
#include <errno.h>
#include <math.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

typedef struct { uint64_t frame; uint32_t slot; } Drawn; /* to the reader */
typedef struct { uint64_t hash; uint32_t slot; } Read;   /* back from it: the slot is free again */

/* -- Messages ----------------------------------------------------------------------------------------------------- */

/* Sends who we are, with the descriptors of the ring's memory and, where it is shared, of the timeline. */
static void send_hello(int to, const Hello *hello, const int *descriptors, size_t count)
{
    union { char bytes[CMSG_SPACE((RING + 1) * sizeof(int))]; struct cmsghdr aligned; } control = {{0}};
    struct iovec text = {(void *)hello, sizeof *hello};
    struct msghdr message = {.msg_iov = &text, .msg_iovlen = 1, .msg_control = control.bytes,
                             .msg_controllen = CMSG_SPACE(count * sizeof(int))};
    struct cmsghdr *rights = CMSG_FIRSTHDR(&message);
    rights->cmsg_level = SOL_SOCKET;
    rights->cmsg_type = SCM_RIGHTS;
    rights->cmsg_len = CMSG_LEN(count * sizeof(int));
    memcpy(CMSG_DATA(rights), descriptors, count * sizeof(int));
    if (sendmsg(to, &message, MSG_NOSIGNAL) < 0) fail("sendmsg", strerror(errno));
}

static void receive_hello(int from, Hello *hello, int *descriptors)
{
    union { char bytes[CMSG_SPACE((RING + 1) * sizeof(int))]; struct cmsghdr aligned; } control;
    struct iovec text = {hello, sizeof *hello};
    struct msghdr message = {.msg_iov = &text, .msg_iovlen = 1, .msg_control = control.bytes,
                             .msg_controllen = sizeof control.bytes};
    if (recvmsg(from, &message, MSG_WAITALL) != sizeof *hello || !CMSG_FIRSTHDR(&message))
        fail("recvmsg", "the renderer said nothing");
    memcpy(descriptors, CMSG_DATA(CMSG_FIRSTHDR(&message)), (RING + !!hello->has_semaphore) * sizeof(int));
}

static uint64_t hash(const uint8_t *bytes)
{
    uint64_t hash = 0xcbf29ce484222325;
    for (size_t i = 0; i < BYTES; i++) hash = (hash ^ bytes[i]) * 0x100000001b3;
    return hash;
}

/* -- The renderer ------------------------------------------------------------------------------------------------- */

/* A camera that goes around the world's origin. */
static NspCamera camera(uint64_t frame)
{
    double sine = sin(0.1 * (double)frame), cosine = cos(0.1 * (double)frame);
    NspCamera made = {sizeof made, WIDTH, HEIGHT, {250, 250}, {WIDTH / 2.0, HEIGHT / 2.0},
                      {cosine, 0, -sine, 0, 0, 1, 0, 0, sine, 0, cosine, 4}, 0, 0, {0}};
    return made;
}

typedef struct {
    int socket, is_alone; /* the reader is gone */
    int is_free[RING];
    const uint8_t *own[RING]; /* the same pictures, read here */
    int read, different;
} Ring;

/* A reader that died closed its socket: no slot is its own then. */
static void go_on_alone(Ring *ring)
{
    ring->is_alone = 1;
    for (int i = 0; i < RING; i++) ring->is_free[i] = 1;
}

/* Waits until the reader gives a slot back. */
static void take_back(Ring *ring)
{
    Read read;
    if (recv(ring->socket, &read, sizeof read, MSG_WAITALL) != sizeof read) {
        go_on_alone(ring);
        return;
    }
    ring->is_free[read.slot] = 1;
    ring->read++;
    ring->different += read.hash != hash(ring->own[read.slot]);
}

/* Records a view of the model into an image, which is in state `after` then. What it held is lost. */
static void draw(NspRenderer *renderer, const NspModel *model, VkCommandBuffer commands, uint64_t frame, VkImage image,
                 NspImageState after)
{
    NspCamera view = camera(frame);
    NspImage color = {.struct_size = sizeof color, .image = image, .format = VK_FORMAT_R16G16B16A16_SFLOAT, .extent = {WIDTH, HEIGHT},
        .before = {.stages = VK_PIPELINE_STAGE_2_ALL_TRANSFER_BIT},
        .after = after};
    NspRender render = {.struct_size = sizeof render, .commands = commands, .frame = frame,
                        .cameras = &view, .camera_count = 1, .color = &color};
    NSP(nsp_record_render(renderer, model, &render));
}

static int render(int socket, const char *path, uint64_t frame_count)
{
    Gpu gpu = open_gpu(NULL);
    NspHostDevice host = {.struct_size = sizeof host, .get_instance_proc_addr = vkGetInstanceProcAddr,
        .instance = gpu.instance, .physical_device = gpu.physical, .device = gpu.device, .queue_family = gpu.family,
        .flags = NSP_DEVICE_RECORD_ONLY, .extensions = gpu.extensions, .extension_count = gpu.extension_count,
        .frames = gpu.frames};
    NspDevice *device;
    NspModel *model;
    NspRenderer *renderer;
    NSP(nsp_device_from_host(&host, &device));
    NSP(nsp_model_load(device, path, &model));
    NSP(nsp_renderer_create(device, model, &renderer));
    /* The two renders of a frame below are alike from the first frame on. */
    NSP(nsp_renderer_reserve(renderer, WIDTH, HEIGHT, 1 << 20));

    Ring ring = {.socket = socket};
    Image shared[RING], own = make_image(&gpu, ALONE);
    Slot slots[RING];
    int descriptors[RING + 1];
    for (int i = 0; i < RING; i++) {
        shared[i] = make_image(&gpu, EXPORTED);
        slots[i] = make_slot(&gpu);
        descriptors[i] = memory_descriptor(&gpu, shared[i].memory);
        ring.own[i] = slots[i].bytes;
        ring.is_free[i] = 1;
    }
    if (gpu.hello.has_semaphore) descriptors[RING] = timeline_descriptor(&gpu);
    size_t count = RING + !!gpu.hello.has_semaphore;
    send_hello(socket, &gpu.hello, descriptors, count);
    for (size_t i = 0; i < count; i++) close(descriptors[i]); /* the message has its own */

    for (uint64_t frame = 1; frame <= frame_count; frame++) {
        Drawn drawn = {.frame = frame, .slot = (uint32_t)(frame % RING)};
        while (!ring.is_free[drawn.slot]) take_back(&ring);
        Slot *slot = &slots[drawn.slot];
        wait_frame(&gpu, frame > RING ? frame - RING : 0);
        begin(slot->commands);
        NspImageState released = {.layout = VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL,
                                  .family = VK_QUEUE_FAMILY_EXTERNAL, .is_owned = 1};
        draw(renderer, model, slot->commands, frame, shared[drawn.slot].image, released);
        /* Only to compare: the same view into an image of our own, which is read here. */
        NspImageState copied = {.layout = VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL,
                                .stages = VK_PIPELINE_STAGE_2_ALL_TRANSFER_BIT,
                                .access = VK_ACCESS_2_TRANSFER_READ_BIT};
        draw(renderer, model, slot->commands, frame, own.image, copied);
        read_image(slot, own.image);
        submit(&gpu, slot->commands, VK_NULL_HANDLE, 0, gpu.frames, frame);
        /* Without a timeline that both know, the message is what tells that the frame is done. */
        if (!gpu.hello.has_semaphore) wait_frame(&gpu, frame);
        if (ring.is_alone) continue;
        ring.is_free[drawn.slot] = 0;
        if (send(socket, &drawn, sizeof drawn, MSG_NOSIGNAL) != sizeof drawn) go_on_alone(&ring);
    }
    shutdown(socket, SHUT_WR);
    wait_frame(&gpu, frame_count);
    for (int i = 0; i < RING; i++)
        while (!ring.is_free[i]) take_back(&ring);
    printf("%d frames of %d were read by the other process%s, %d differ; ordered by %s\n", ring.read, (int)frame_count,
           ring.is_alone ? ", which is gone" : "", ring.different,
           gpu.hello.has_semaphore ? "a timeline semaphore" : "messages");

    nsp_renderer_destroy(renderer);
    nsp_model_destroy(model);
    nsp_device_destroy(device);
    for (int i = 0; i < RING; i++) free_image(&gpu, shared[i]), free_slot(&gpu, slots[i]);
    free_image(&gpu, own);
    close_gpu(&gpu);
    return ring.different != 0;
}

/* -- The reader --------------------------------------------------------------------------------------------------- */

static int read_frames(int socket, uint64_t last)
{
    Hello hello;
    int descriptors[RING + 1];
    receive_hello(socket, &hello, descriptors);
    Gpu gpu = open_gpu(&hello);
    if (hello.has_semaphore) import_timeline(&gpu, descriptors[RING]);
    Image shared[RING];
    for (int i = 0; i < RING; i++) shared[i] = make_image(&gpu, descriptors[i]);
    Slot slot = make_slot(&gpu);

    Drawn drawn;
    for (uint64_t own = 1; recv(socket, &drawn, sizeof drawn, MSG_WAITALL) == sizeof drawn; own++) {
        begin(slot.commands);
        acquire_external(&gpu, slot.commands, shared[drawn.slot].image);
        read_image(&slot, shared[drawn.slot].image);
        submit(&gpu, slot.commands, hello.has_semaphore ? gpu.timeline : VK_NULL_HANDLE, drawn.frame, gpu.frames, own);
        wait_frame(&gpu, own);
        Read read = {hash(slot.bytes), drawn.slot};
        if (send(socket, &read, sizeof read, MSG_NOSIGNAL) != sizeof read) fail("send", "the renderer is gone");
        if (drawn.frame == last) _exit(0); /* as a process that crashes */
    }
    for (int i = 0; i < RING; i++) free_image(&gpu, shared[i]);
    free_slot(&gpu, slot);
    close_gpu(&gpu);
    return 0;
}

int main(int count, char **arguments)
{
    if (count < 2) fail("usage", "share MODEL.ply [FRAMES [LAST]]");
    uint64_t frames = count > 2 ? strtoul(arguments[2], NULL, 10) : 12, last = 0;
    if (count > 3) last = strtoul(arguments[3], NULL, 10);
    int ends[2], status = 1;
    if (socketpair(AF_UNIX, SOCK_STREAM, 0, ends)) fail("socketpair", strerror(errno));
    /* Before either process has a device: what a driver holds does not survive a fork. */
    pid_t reader = fork();
    if (reader < 0) fail("fork", strerror(errno));
    close(ends[reader ? 1 : 0]);
    if (!reader) return read_frames(ends[1], last);
    int failed = render(ends[0], arguments[1], frames);
    close(ends[0]);
    waitpid(reader, &status, 0);
    return failed || !WIFEXITED(status) || WEXITSTATUS(status);
}
