/* Calls of the C interface that are wrong, and hosts that lack something, each in a process of its own: the process
 * lives, and the call has the code that is expected and a text that has the words.
 *
 *     wrong_calls MODEL.ply        prints what went wrong; the exit code is the number of such cases
 */
#include <math.h>
#include <nightsplat.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/wait.h>
#include <unistd.h>
#include <vulkan/vulkan.h>

enum { SIDE = 64 };
#define COUNT(array) (sizeof(array) / sizeof *(array))
#define VK(call) do { if ((call) != VK_SUCCESS) printf("  %s failed\n", #call), exit(9); } while (0)

static const char *path, *what;
static VkInstance instance;
static VkPhysicalDevice physical;
static VkDevice device;
static VkQueue queue;
static VkCommandBuffer commands;
static NspDevice *nsp;
static NspModel *model;
static NspRenderer *renderer;
static int wrong;

/* The call has this code, and a text that has the words. */
static void expect(const char *call, NspResult result, NspResult code, const char *words)
{
    const char *text = result < 0 ? nsp_last_error() : "";
    if (result == code && strstr(text, words) && !strchr(text, '\n')) return;
    printf("  %s, %s: %d (%s), not %d with `%s`\n", what, call, (int)result, text, (int)code, words);
    wrong++;
}
#define EXPECT(code, words, call) expect(#call, call, code, words)

static void open_instance(uint32_t version)
{
    VkApplicationInfo app = {.sType = VK_STRUCTURE_TYPE_APPLICATION_INFO, .apiVersion = version};
    VkInstanceCreateInfo info = {.sType = VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO, .pApplicationInfo = &app};
    VK(vkCreateInstance(&info, NULL, &instance));
    uint32_t count = 1;
    if (vkEnumeratePhysicalDevices(instance, &count, &physical) < 0 || count == 0) exit(9);
}

static void open_device(const void *features, const char *const *extensions, uint32_t count)
{
    float priority = 1;
    VkDeviceQueueCreateInfo queues = {.sType = VK_STRUCTURE_TYPE_DEVICE_QUEUE_CREATE_INFO, .queueCount = 1,
                                      .pQueuePriorities = &priority};
    VkDeviceCreateInfo info = {.sType = VK_STRUCTURE_TYPE_DEVICE_CREATE_INFO, .pNext = features,
        .queueCreateInfoCount = 1, .pQueueCreateInfos = &queues, .enabledExtensionCount = count,
        .ppEnabledExtensionNames = extensions};
    NspFeatureStructs structs = {.struct_size = sizeof structs};
    if (!features) EXPECT(NSP_OK, "", nsp_require_features(&info, &structs));
    VK(vkCreateDevice(physical, &info, NULL, &device));
    vkGetDeviceQueue(device, 0, 0, &queue);
    VkCommandPoolCreateInfo pool_info = {.sType = VK_STRUCTURE_TYPE_COMMAND_POOL_CREATE_INFO,
                                         .flags = VK_COMMAND_POOL_CREATE_RESET_COMMAND_BUFFER_BIT};
    VkCommandPool pool;
    VK(vkCreateCommandPool(device, &pool_info, NULL, &pool));
    VkCommandBufferAllocateInfo info2 = {.sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_ALLOCATE_INFO, .commandPool = pool,
                                         .commandBufferCount = 1};
    VK(vkAllocateCommandBuffers(device, &info2, &commands));
}

static NspHostDevice host(void)
{
    return (NspHostDevice){.struct_size = sizeof(NspHostDevice), .get_instance_proc_addr = vkGetInstanceProcAddr,
        .instance = instance, .physical_device = physical, .device = device, .flags = NSP_DEVICE_RECORD_ONLY};
}

static void ready(void)
{
    open_instance(VK_API_VERSION_1_3);
    open_device(NULL, NULL, 0);
    NspHostDevice lent = host();
    EXPECT(NSP_OK, "", nsp_device_from_host(&lent, &nsp));
    EXPECT(NSP_OK, "", nsp_model_load(nsp, path, &model));
    EXPECT(NSP_OK, "", nsp_renderer_create(nsp, model, &renderer));
}

static NspImage image(VkFormat format)
{
    VkImageCreateInfo info = {.sType = VK_STRUCTURE_TYPE_IMAGE_CREATE_INFO, .imageType = VK_IMAGE_TYPE_2D,
        .format = format, .extent = {SIDE, SIDE, 1}, .mipLevels = 1, .arrayLayers = 1, .samples = 1,
        .usage = VK_IMAGE_USAGE_TRANSFER_DST_BIT | VK_IMAGE_USAGE_TRANSFER_SRC_BIT};
    NspImage made = {.struct_size = sizeof made, .format = format, .extent = {SIDE, SIDE}};
    VK(vkCreateImage(device, &info, NULL, &made.image));
    VkMemoryRequirements needed;
    vkGetImageMemoryRequirements(device, made.image, &needed);
    VkMemoryAllocateInfo allocate = {.sType = VK_STRUCTURE_TYPE_MEMORY_ALLOCATE_INFO, .allocationSize = needed.size};
    while (!(needed.memoryTypeBits >> allocate.memoryTypeIndex & 1)) allocate.memoryTypeIndex++;
    VkDeviceMemory memory;
    VK(vkAllocateMemory(device, &allocate, NULL, &memory));
    VK(vkBindImageMemory(device, made.image, memory, 0));
    made.after.layout = VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL;
    made.after.stages = VK_PIPELINE_STAGE_2_ALL_TRANSFER_BIT;
    made.after.access = VK_ACCESS_2_TRANSFER_READ_BIT;
    return made;
}

static NspCamera camera(void)
{
    return (NspCamera){.struct_size = sizeof(NspCamera), .width = SIDE, .height = SIDE, .focal = {SIDE, SIDE},
        .principal_point = {SIDE / 2.0, SIDE / 2.0}, .view_from_world = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4}};
}

static NspRender render(const NspCamera *view, const NspImage *color)
{
    static uint64_t frame;
    return (NspRender){.struct_size = sizeof(NspRender), .commands = commands, .frame = ++frame, .cameras = view,
                       .camera_count = 1, .color = color};
}

static void begin(void)
{
    VkCommandBufferBeginInfo info = {.sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_BEGIN_INFO};
    VK(vkBeginCommandBuffer(commands, &info));
}

static void submit(uint64_t frame)
{
    VkSubmitInfo info = {.sType = VK_STRUCTURE_TYPE_SUBMIT_INFO, .commandBufferCount = 1, .pCommandBuffers = &commands};
    VK(vkEndCommandBuffer(commands));
    VK(vkQueueSubmit(queue, 1, &info, VK_NULL_HANDLE));
    VK(vkQueueWaitIdle(queue));
    EXPECT(NSP_OK, "", nsp_frames_done(nsp, frame));
}

/* -- Hosts -------------------------------------------------------------------------------------------------------- */

static PFN_vkVoidFunction knows_nothing(VkInstance given, const char *name)
{
    (void)given, (void)name;
    return NULL;
}

static void a_loader_that_knows_nothing(void)
{
    open_instance(VK_API_VERSION_1_3);
    open_device(NULL, NULL, 0);
    NspHostDevice lent = host();
    lent.get_instance_proc_addr = knows_nothing;
    EXPECT(NSP_ERROR_DEVICE, "does not know vk", nsp_device_from_host(&lent, &nsp));
    EXPECT(NSP_ERROR_DEVICE, "does not know vk", nsp_check_device(knows_nothing, instance, physical));
}

/* An instance that is too old, without the extensions that would do. */
static void an_old_instance(uint32_t version, const char *word, const char *remedy)
{
    open_instance(version);
    VkPhysicalDeviceFeatures2 none = {.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_FEATURES_2};
    open_device(&none, NULL, 0);
    NspHostDevice lent = host();
    EXPECT(NSP_ERROR_DEVICE, word, nsp_device_from_host(&lent, &nsp));
    if (!strstr(nsp_last_error(), remedy)) printf("  no remedy: %s\n", nsp_last_error()), wrong++;
}

static void an_instance_of_1_0(void) { an_old_instance(VK_API_VERSION_1_0, "the device has no vk", "VK_API_VERSION_1_"); }
static void an_instance_of_1_1(void) { an_old_instance(VK_API_VERSION_1_1, "the device has no vk", "1_"); }
static void an_instance_of_1_2(void)
{
    an_old_instance(VK_API_VERSION_1_2, "vkCmdPipelineBarrier2", "VK_KHR_synchronization2");
}

static void features_that_are_missing(void)
{
    open_instance(VK_API_VERSION_1_3);
    VkPhysicalDeviceFeatures2 none = {.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_FEATURES_2};
    open_device(&none, NULL, 0);
    NspHostDevice lent = host();
    lent.features = &none;
    EXPECT(NSP_ERROR_DEVICE, "lack timelineSemaphore", nsp_device_from_host(&lent, &nsp));
    VkPhysicalDeviceTimelineSemaphoreFeatures one = {
        .sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_TIMELINE_SEMAPHORE_FEATURES, .timelineSemaphore = 1};
    none.pNext = &one;
    EXPECT(NSP_ERROR_DEVICE, "lack scalarBlockLayout", nsp_device_from_host(&lent, &nsp));
}

static void members_of_a_host(void)
{
    open_instance(VK_API_VERSION_1_3);
    open_device(NULL, NULL, 0);
#define LEND(code, words, change) do { NspHostDevice lent = host(); change; \
    EXPECT(code, words, nsp_device_from_host(&lent, &nsp)); } while (0)
    LEND(NSP_ERROR_USAGE, "::queue is NULL", lent.flags = 0);
    LEND(NSP_ERROR_USAGE, "queue_family 7", lent.queue_family = 7);
    LEND(NSP_ERROR_USAGE, "unknown bits 0xffff0000", lent.flags = 0xffff0000);
    LEND(NSP_ERROR_USAGE, "::extensions is NULL", lent.extension_count = 1);
    LEND(NSP_ERROR_USAGE, "struct_size is 0", lent.struct_size = 0);
    LEND(NSP_ERROR_VERSION, "struct_size is 8", lent.struct_size = 8);
    LEND(NSP_ERROR_VERSION, "struct_size", lent.struct_size = (size_t)-1);
    NspMemoryFunctions functions = {.struct_size = sizeof functions};
    LEND(NSP_ERROR_USAGE, "allocate and free", lent.device_memory = &functions);
    EXPECT(NSP_ERROR_USAGE, "chain is NULL", nsp_require_features(NULL, NULL));
    VkDeviceCreateInfo info = {.sType = VK_STRUCTURE_TYPE_DEVICE_CREATE_INFO};
    EXPECT(NSP_ERROR_USAGE, "structs is NULL", nsp_require_features(&info, NULL));
    NspFeatureStructs structs = {.struct_size = 8};
    EXPECT(NSP_ERROR_VERSION, "struct_size", nsp_require_features(&info, &structs));
}

static VkResult denies(void *user, const VkMemoryRequirements *needed, VkMemoryPropertyFlags required,
                       VkMemoryPropertyFlags preferred, const char *name, NspMemory *out)
{
    (void)user, (void)needed, (void)required, (void)preferred, (void)name, (void)out;
    return VK_ERROR_OUT_OF_DEVICE_MEMORY;
}

static VkResult lies(void *user, const VkMemoryRequirements *needed, VkMemoryPropertyFlags required,
                     VkMemoryPropertyFlags preferred, const char *name, NspMemory *out)
{
    (void)user, (void)needed, (void)required, (void)preferred, (void)name;
    memset(out, 0, sizeof *out);
    return VK_SUCCESS;
}

static void frees(void *user, const NspMemory *memory)
{
    (void)user, (void)memory;
}

static void an_allocator_that_gives_nothing(void)
{
    open_instance(VK_API_VERSION_1_3);
    open_device(NULL, NULL, 0);
    NspHostDevice lent = host();
    NspMemoryFunctions functions = {.struct_size = sizeof functions, .allocate = denies, .free = frees};
    lent.device_memory = &functions;
    EXPECT(NSP_OK, "", nsp_device_from_host(&lent, &nsp));
    EXPECT(NSP_ERROR_MEMORY, "out of memory", nsp_model_load(nsp, path, &model));
    functions.allocate = lies;
    EXPECT(NSP_OK, "", nsp_device_from_host(&lent, &nsp));
    EXPECT(NSP_ERROR_INTERNAL, "memory that is null", nsp_model_load(nsp, path, &model));
}

/* -- Models ------------------------------------------------------------------------------------------------------- */

static void models(void)
{
    ready();
    NspModel *made;
    float mean[3] = {0}, quat[4] = {1}, scale[3] = {NAN}, opacity[1] = {0}, dc[3] = {0};
    const float *none[6] = {0}, *planes[6] = {mean, quat, scale, opacity, dc, NULL};
    EXPECT(NSP_ERROR_USAGE, "plane 0", nsp_model_create(nsp, UINT32_MAX, 3, none, &made));
    EXPECT(NSP_ERROR_MEMORY, "pass fewer", nsp_model_create(nsp, UINT32_MAX, 0, planes, &made));
    EXPECT(NSP_ERROR_USAGE, "sh_degree is 9", nsp_model_create(nsp, 1, 9, planes, &made));
    EXPECT(NSP_ERROR_NOT_FINITE, "plane 2", nsp_model_create(nsp, 1, 0, planes, &made));
    EXPECT(NSP_ERROR_INPUT, "absent.ply", nsp_model_load(nsp, "absent.ply", &made));
    EXPECT(NSP_ERROR_USAGE, "not UTF-8", nsp_model_load(nsp, "\xff\xfe", &made));
    double pose[12] = {NAN, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0};
    const NspModel *one[1] = {model};
    EXPECT(NSP_ERROR_USAGE, "not rigid", nsp_model_join(nsp, one, (const double(*)[12])pose, 1, &made));
    pose[0] = -1;
    EXPECT(NSP_ERROR_USAGE, "not rigid", nsp_model_join(nsp, one, (const double(*)[12])pose, 1, &made));
    EXPECT(NSP_ERROR_USAGE, "draw a smaller view", nsp_renderer_reserve(renderer, UINT32_MAX, UINT32_MAX, 0));
}

/* -- Renders ------------------------------------------------------------------------------------------------------ */

static void renders(void)
{
    ready();
    begin();
    NspImage color = image(VK_FORMAT_R8G8B8A8_UNORM), depth = image(VK_FORMAT_R32_SFLOAT), other;
    NspCamera view = camera(), moved;
#define DRAW(words, change) do { NspRender drawn = render(&view, &color); other = color, moved = view; change; \
    EXPECT(NSP_ERROR_USAGE, words, nsp_record_render(renderer, model, &drawn)); } while (0)
    DRAW("::commands is NULL", drawn.commands = NULL);
    DRAW("::cameras", drawn.camera_count = 0);
    DRAW("layers", drawn.camera_count = 2);
    DRAW("layers", (other.layer = 1, drawn.color = &other));
    DRAW("layers", (other.layer = UINT32_MAX, drawn.color = &other));
    DRAW("unknown bits", drawn.flags = 1u << 31);
    DRAW("pass one of them", drawn.instance_count = 7);
    DRAW("NspImage::struct_size", (other.struct_size = 0, drawn.color = &other));
    DRAW("is null", (other.image = VK_NULL_HANDLE, drawn.color = &other));
    DRAW("format", (other.format = VK_FORMAT_R8_UNORM, drawn.color = &other));
    DRAW("is_owned", (other.after.is_owned = 2, drawn.color = &other));
    DRAW("no layout after", (other.after.layout = VK_IMAGE_LAYOUT_UNDEFINED, drawn.color = &other));
    DRAW("smaller than", (other.extent.width = 63, drawn.color = &other));
    DRAW("NspCamera::struct_size", (moved.struct_size = 0, drawn.cameras = &moved));
    DRAW("camera 0 has unknown flags", (moved.flags = 8, drawn.cameras = &moved));
    DRAW("0x64", (moved.width = 0, drawn.cameras = &moved));
    DRAW("focal length", (moved.focal[0] = NAN, drawn.cameras = &moved));
    DRAW("focal length [1e300, ", (moved.focal[0] = 1e300, drawn.cameras = &moved));
    DRAW("not finite", (moved.principal_point[0] = 1e30, drawn.cameras = &moved));
    DRAW("not finite", (moved.view_from_world[3] = 1e30, drawn.cameras = &moved));
    DRAW("not rigid", (moved.view_from_world[0] = 2, drawn.cameras = &moved));
    DRAW("background", drawn.background[1] = NAN);
    DRAW("exposure", drawn.exposure = NAN);
    DRAW("near plane", drawn.scene_depth = &depth);
    DRAW("color image as well", (other.image = depth.image, drawn.color = &other, drawn.scene_depth = &depth,
                                 drawn.flags = NSP_DEPTH_LINEAR));
    DRAW("state your projection", (depth.format = VK_FORMAT_D32_SFLOAT, drawn.depth_out = &depth,
                                   drawn.flags = NSP_DEPTH_LINEAR));
    DRAW("near plane", drawn.depth_out = &depth);
    DRAW("far plane is infinite", (drawn.depth_out = &depth, drawn.scene_near = 1,
                                   moved.flags = NSP_CAMERA_ORTHOGRAPHIC, drawn.cameras = &moved));
    DRAW("exclude each other", (moved.flags = NSP_CAMERA_ORTHOGRAPHIC | NSP_CAMERA_FISHEYE, drawn.cameras = &moved));
    DRAW("hdr10_nits is -1", drawn.hdr10_nits = -1);
    DRAW("hdr10_nits is NaN", drawn.hdr10_nits = NAN);
    DRAW("A2B10G10R10", drawn.hdr10_nits = 203);
    DRAW("NspRender::reserved", drawn.reserved = 1);
    DRAW("picked pixel", (drawn.flags = NSP_RENDER_PICK, drawn.pick[1] = UINT32_MAX));
    DRAW("NspCamera is NULL", drawn.motion_out = &color);
    DRAW("Rg16Float", (drawn.motion_out = &color, drawn.cameras_before = &view));
    DRAW("one size", (other.format = VK_FORMAT_R16G16_SFLOAT, drawn.motion_out = &other, moved.width = 1,
                      drawn.cameras_before = &moved));
    DRAW("is null", (other.format = VK_FORMAT_R16G16_SFLOAT, other.image = VK_NULL_HANDLE, drawn.motion_out = &other,
                     drawn.cameras_before = &view));
    NspInstance moving = {.struct_size = sizeof moving, .model = model, .pose_before = {NAN}};
    NspRender instanced = render(&view, &color);
    instanced.instances = &moving, instanced.instance_count = 1;
    EXPECT(NSP_ERROR_USAGE, "pose before", nsp_record_render(renderer, NULL, &instanced));
    NspPick pick = {.struct_size = 8};
    EXPECT(NSP_ERROR_VERSION, "NspPick", nsp_renderer_picked(renderer, &pick));
    EXPECT(NSP_ERROR_USAGE, "NspPick is NULL", nsp_renderer_picked(renderer, NULL));
    EXPECT(NSP_ERROR_USAGE, "renderer is NULL", nsp_renderer_picked(NULL, &pick));
    pick.struct_size = sizeof pick;
    EXPECT(NSP_OK, "", nsp_renderer_picked(renderer, &pick));
    if (pick.frame != 0 || pick.is_hit) printf("  a pick of nothing\n"), wrong++;
    DRAW("no tone law", drawn.flags = NSP_RENDER_PHOTOGRAPH);
    NspRender drawn = render(&view, &color);
    EXPECT(NSP_OK, "", nsp_record_render(renderer, model, &drawn));
    drawn.frame--;
    EXPECT(NSP_ERROR_USAGE, "never fall", nsp_record_render(renderer, model, &drawn));
    submit(drawn.frame + 1);
}

/* A recording that is never submitted takes no upload with it. */
static void a_recording_that_is_dropped(void)
{
    ready();
    NspImage color = image(VK_FORMAT_R8G8B8A8_UNORM);
    NspCamera view = camera();
    NspStatus status = {.struct_size = sizeof status};
    uint32_t seen[2];
    for (int is_dropped = 1; is_dropped >= 0; is_dropped--) {
        begin();
        NspRender drawn = render(&view, &color);
        EXPECT(NSP_OK, "", nsp_record_render(renderer, model, &drawn));
        if (is_dropped) {
            VK(vkResetCommandBuffer(commands, 0));
            EXPECT(NSP_OK, "", nsp_frames_done(nsp, drawn.frame));
        } else {
            submit(drawn.frame);
        }
    }
    EXPECT(NSP_OK, "", nsp_renderer_status(renderer, &status));
    seen[0] = status.intersections;
    /* Uploads alone, and the same picture. */
    nsp_model_destroy(model), nsp_renderer_destroy(renderer);
    EXPECT(NSP_OK, "", nsp_model_load(nsp, path, &model));
    EXPECT(NSP_OK, "", nsp_renderer_create(nsp, model, &renderer));
    NspRender drawn = render(&view, &color);
    begin();
    EXPECT(NSP_OK, "", nsp_record_uploads(nsp, commands, drawn.frame));
    submit(drawn.frame);
    begin();
    drawn.frame++;
    EXPECT(NSP_OK, "", nsp_record_render(renderer, model, &drawn));
    submit(drawn.frame);
    EXPECT(NSP_OK, "", nsp_renderer_status(renderer, &status));
    seen[1] = status.intersections;
    if (seen[0] == 0 || seen[0] != seen[1]) printf("  %u and %u intersections\n", seen[0], seen[1]), wrong++;
}

static void matrices(void)
{
    float view[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, -4, 1};
    float clip[16] = {1.5f, 0, 0, 0, 0, -1.5f, 0, 0, 0, 0, -1.001f, -1, 0, 0, -.1f, 0};
    NspCamera made = {.struct_size = sizeof made};
    EXPECT(NSP_OK, "", nsp_camera_from_matrices(view, clip, SIDE, SIDE, &made));
    clip[5] = 1.5f;
    EXPECT(NSP_ERROR_USAGE, "projection[5]", nsp_camera_from_matrices(view, clip, SIDE, SIDE, &made));
    clip[5] = -1.5f, view[0] = view[5] = view[10] = 2;
    EXPECT(NSP_ERROR_USAGE, "divide its scale", nsp_camera_from_matrices(view, clip, SIDE, SIDE, &made));
    view[0] = NAN;
    EXPECT(NSP_ERROR_USAGE, "not finite", nsp_camera_from_matrices(view, clip, SIDE, SIDE, &made));
    EXPECT(NSP_ERROR_USAGE, "is NULL", nsp_camera_from_matrices(NULL, clip, SIDE, SIDE, &made));
}

/* -- Training ----------------------------------------------------------------------------------------------------- */

static void trainers(void)
{
    ready();
    NspWatch *watch = NULL;
    NspTrainer *trainer = NULL;
    NspScore score = {.struct_size = sizeof score};
    uint32_t count = 1;
    EXPECT(NSP_ERROR_USAGE, "watch is NULL", nsp_watch_create(NULL, NULL, NULL));
    EXPECT(NSP_ERROR_USAGE, "watch is NULL", nsp_watch_stop(NULL));
    nsp_watch_destroy(NULL);
    EXPECT(NSP_OK, "", nsp_watch_create(NULL, NULL, &watch));
    EXPECT(NSP_OK, "", nsp_watch_stop(watch));
    if (nsp_trainer_create(nsp, "absent", NULL, watch, &trainer) >= 0) printf("  a trainer of nothing\n"), wrong++;
    EXPECT(NSP_ERROR_USAGE, "trainer is NULL", nsp_trainer_advance(NULL, 1, 1, NULL, NULL));
    EXPECT(NSP_ERROR_USAGE, "trainer is NULL", nsp_trainer_scores(NULL, &score, &count));
    if (nsp_trainer_has_ended(NULL)) printf("  nothing has ended\n"), wrong++;
    nsp_watch_destroy(watch);
}

/* -- All ---------------------------------------------------------------------------------------------------------- */

#define CASE(name) {#name, name}
static const struct { const char *name; void (*run)(void); } cases[] = {
    CASE(a_loader_that_knows_nothing), CASE(an_instance_of_1_0), CASE(an_instance_of_1_1), CASE(an_instance_of_1_2),
    CASE(features_that_are_missing), CASE(members_of_a_host), CASE(an_allocator_that_gives_nothing), CASE(models),
    CASE(renders), CASE(a_recording_that_is_dropped), CASE(matrices), CASE(trainers),
};

int main(int argc, char **argv)
{
    if (argc != 2) return fprintf(stderr, "usage: wrong_calls MODEL.ply\n"), 255;
    path = argv[1];
    int failed = 0;
    for (size_t i = 0; i < COUNT(cases); i++) {
        pid_t child = fork();
        if (child == 0) {
            what = cases[i].name;
            cases[i].run();
            fflush(stdout);
            _exit(wrong != 0);
        }
        int status = 0;
        if (child < 0 || waitpid(child, &status, 0) < 0) return 255;
        if (WIFSIGNALED(status)) printf("%s died of signal %d\n", cases[i].name, WTERMSIG(status));
        else if (WEXITSTATUS(status)) printf("%s ended with %d\n", cases[i].name, WEXITSTATUS(status));
        failed += status != 0;
        fflush(stdout);
    }
    printf("%d of %d cases are wrong\n", failed, (int)COUNT(cases));
    return failed;
}
