/* Gaussian splatting on the host's VkDevice. C99 and C++11. Written by cbindgen from src/capi: edit that.

   Every pointer is read during the call alone. An NspDevice may be used from any thread; a model, a renderer or a
   trainer from one at a time. Nothing is global but nsp_set_log. Structs that begin with struct_size are set to zero
   and to their size first; their members are only appended. docs/embedding.md is the contract. */

#ifndef NIGHTSPLAT_H
#define NIGHTSPLAT_H

#include <stddef.h>
#include <stdint.h>
#include <vulkan/vulkan_core.h>

// The version of this header, as `VK_MAKE_API_VERSION(0, major, minor, patch)`.
#define NSP_HEADER_VERSION (1 << 12)

// The queue is never touched: uploads are part of the next recording, and training is refused.
#define NSP_DEVICE_RECORD_ONLY 1

// The queue is internally synchronized (`VK_KHR_internally_synchronized_queues`): no lock is taken.
#define NSP_DEVICE_QUEUE_SYNCHRONIZED 2

// `VK_EXT_debug_utils` is enabled on the instance: objects are named, passes are labelled.
#define NSP_DEVICE_NAMES_OBJECTS 4

// Blended over what `color` holds, instead of replacing it.
#define NSP_RENDER_OVER 1

// A float image gets display-referred values, as they were trained.
#define NSP_RENDER_DISPLAY_FLOAT 2

// `scene_depth` is 1 at the near plane.
#define NSP_DEPTH_REVERSED 4

// `scene_depth` is the depth in the view, world units.
#define NSP_DEPTH_LINEAR 8

// `depth_out` is the mean of what is seen; otherwise the depth at which half of it is.
#define NSP_DEPTH_EXPECTED 16

// Colours are those of the dark photographs, by the law that the model states: their linear light where the image is
// linear, else their values. `background` stays.
#define NSP_RENDER_PHOTOGRAPH 32

// A device and what belongs to it. Any thread may use it.
typedef struct NspDevice NspDevice;

// A model on a device. One thread uses it at a time.
typedef struct NspModel NspModel;

// A renderer: kernels, and memory that grows with the views. One thread uses it at a time.
typedef struct NspRenderer NspRenderer;

// A training. One thread uses it at a time.
typedef struct NspTrainer NspTrainer;

// 0 or more: done. Otherwise an error, whose text is in `nsp_last_error`.
typedef int32_t NspResult;

// A piece of device memory of the host's.
typedef struct NspMemory {
    // The block that it is part of.
    VkDeviceMemory memory;
    // From the start of the block; a multiple of the required alignment.
    VkDeviceSize offset;
    // The address of its first byte where host-visible memory is required; ignored otherwise.
    void *mapped;
    // The host's own.
    void *cookie;
} NspMemory;

// The host's allocator of device memory. It may be called from any thread.
typedef struct NspMemoryFunctions {
    // Fills `out` with memory that has every `required` property and, where there is such, every `preferred` one.
    VkResult (*allocate)(void *user,
                         const VkMemoryRequirements *requirements,
                         VkMemoryPropertyFlags required,
                         VkMemoryPropertyFlags preferred,
                         const char *name,
                         struct NspMemory *out);
    // Frees what `allocate` gave.
    void (*free)(void *user, const struct NspMemory *memory);
    // Passed to both.
    void *user;
} NspMemoryFunctions;

// A device that the host lends. It outlives everything that is made with it.
typedef struct NspHostDevice {
    // `sizeof(NspHostDevice)`.
    size_t struct_size;
    // Of the host's loader.
    PFN_vkGetInstanceProcAddr get_instance_proc_addr;
    // Of Vulkan 1.3 or later.
    VkInstance instance;
    // One of the instance's.
    VkPhysicalDevice physical_device;
    // Created with the features of `nsp_require_features`.
    VkDevice device;
    // Of the family below; NULL where the device only records.
    VkQueue queue;
    // A family with compute.
    uint32_t queue_family;
    // `NSP_DEVICE_*`.
    uint32_t flags;
    // Enabled device extensions; what is not listed is not used.
    const char *const *extensions;
    // Their number.
    uint32_t extension_count;
    // Enabled features; NULL: those of `nsp_require_features`.
    const VkPhysicalDeviceFeatures2 *features;
    // Held around `vkQueueSubmit2` alone. Both or none.
    void (*lock_queue)(void *user, VkQueue queue);
    // Releases the lock.
    void (*unlock_queue)(void *user, VkQueue queue);
    // Passed to both.
    void *user;
    // The host's; `VK_NULL_HANDLE`: one of ours that is not saved.
    VkPipelineCache pipeline_cache;
    // For the objects that we create; NULL: the driver's. It outlives the device.
    const VkAllocationCallbacks *host_memory;
    // NULL: blocks of 8 to 256 MiB of our own.
    const struct NspMemoryFunctions *device_memory;
    // A timeline that reaches the number of each frame; `VK_NULL_HANDLE`: the host calls `nsp_frames_done`.
    VkSemaphore frames;
} NspHostDevice;

// A pinhole camera, in axes x right, y down, z forward.
typedef struct NspCamera {
    // Pixels.
    uint32_t width;
    // Pixels.
    uint32_t height;
    // Along x and y, pixels.
    double focal[2];
    // From the corner of the first pixel, pixels.
    double principal_point[2];
    // A rotation and a translation, three rows of four.
    double view_from_world[12];
} NspCamera;

// What is known of a model.
typedef struct NspModelInfo {
    // `sizeof(NspModelInfo)`.
    size_t struct_size;
    // Gaussians.
    uint32_t count;
    // 0 to 3.
    uint32_t sh_degree;
    // The near plane that it was trained with, world units.
    float near_plane;
    // The largest alpha of a splat on a pixel.
    float max_alpha;
    // 1: colours are the raw SH sum.
    uint32_t raw_colors;
    // The stops by which the photographs' linear light is raised to the brightness of the model's colours: their power
    // of two is the exposure for that with `NSP_RENDER_PHOTOGRAPH`. NaN: the model states no law.
    float law_stops;
    // The world position of the model's own origin.
    double origin[3];
} NspModelInfo;

// The state of an image before or after a recording.
typedef struct NspImageState {
    // Its layout.
    VkImageLayout layout;
    // The queue family that owns it; `VK_QUEUE_FAMILY_IGNORED`: ownership is not transferred.
    uint32_t family;
    // Of the host's commands that use it.
    VkPipelineStageFlags2 stages;
    // Of these commands.
    VkAccessFlags2 access;
} NspImageState;

// A layer of an image: mip level 0, one sample; usage `TRANSFER_DST` to be written, `TRANSFER_SRC` to be read.
typedef struct NspImage {
    // The image.
    VkImage image;
    // Its format.
    VkFormat format;
    // At least the camera's.
    VkExtent2D extent;
    // The array layer of the first camera.
    uint32_t layer;
    // As the host leaves it.
    struct NspImageState before;
    // As it is afterwards. Where the families differ, our half of the transfer is recorded.
    struct NspImageState after;
} NspImage;

// One render.
typedef struct NspRender {
    // `sizeof(NspRender)`.
    size_t struct_size;
    // Primary, recording, outside a render pass, of the lent family. It is submitted once, in the order of recording.
    VkCommandBuffer commands;
    // The number that the host's timeline reaches after it; it never falls.
    uint64_t frame;
    // Camera i is drawn into layer `layer + i` of each image.
    const struct NspCamera *cameras;
    // Their number.
    uint32_t camera_count;
    // `NSP_RENDER_*` and `NSP_DEPTH_*`.
    uint32_t flags;
    // RGBA16F (linear), RGBA8 or BGRA8 as UNORM or SRGB, premultiplied; NULL: none.
    const struct NspImage *color;
    // R32F: depth in the view, infinite where nothing is seen; NULL: none.
    const struct NspImage *depth_out;
    // D32, D24 or D16 with or without stencil, or R32F: the depth beyond which nothing is drawn; NULL: none.
    const struct NspImage *scene_depth;
    // The near plane of `scene_depth`, world units.
    float scene_near;
    // The far plane; 0: infinite.
    float scene_far;
    // The factor on linear light; 0 is 1.
    float exposure;
    // Display-referred; shows where alpha is below 1, unless over.
    float background[3];
    // The most intersections of a view, the nearest first; 0: as memory allows.
    uint32_t budget;
    // Unused.
    uint32_t reserved;
} NspRender;

// How the newest frame that is done went.
typedef struct NspStatus {
    // `sizeof(NspStatus)`.
    size_t struct_size;
    // Its number; 0: none is done yet.
    uint64_t frame;
    // Intersections of splats and tiles in its view with the most.
    uint32_t intersections;
    // Those that memory and budget allowed.
    uint32_t capacity;
    // Those that were left out, the farthest.
    uint32_t left_out;
    // Splats of one tile, where the device cannot follow them all and the tile is empty; else 0.
    uint32_t splats_per_tile;
    // Device memory in use by everything made with the device.
    uint64_t device_bytes;
} NspStatus;

// One step of a training.
typedef struct NspStep {
    // Counted from 1.
    uint64_t step;
    // The weighted sum of its loss terms.
    double loss;
    // Gaussians.
    uint32_t gaussians;
    // Unused.
    uint32_t reserved;
} NspStep;

// Done.
#define NSP_OK 0

// Arguments that make no sense; nothing was recorded.
#define NSP_ERROR_USAGE -2

// A file that cannot be used.
#define NSP_ERROR_INPUT -3

// The device lacks a feature, or a limit of it is too low.
#define NSP_ERROR_DEVICE -4

// Out of device or host memory; the object is as it was.
#define NSP_ERROR_MEMORY -5

// The device was lost; destroy everything.
#define NSP_ERROR_LOST -6

// A file that cannot be written.
#define NSP_ERROR_OUTPUT -7

// A `struct_size` below that of version 0.1, or bytes that are not zero beyond what this library reads.
#define NSP_ERROR_VERSION -8

// Not part of this build: training, or a file format.
#define NSP_ERROR_UNSUPPORTED -9

// A number that is not finite.
#define NSP_ERROR_NOT_FINITE -10

// Stopped on request.
#define NSP_ERROR_STOPPED -11

// A bug of the library, caught; the object can only be destroyed.
#define NSP_ERROR_INTERNAL -127

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// The text of this thread's last error: one line, never NULL, valid until the thread's next error.
const char *nsp_last_error(void);

// The library's version, as `VK_MAKE_API_VERSION(0, major, minor, patch)`.
uint32_t nsp_version(void);

// Sets the function that gets the log's lines, from any thread; NULL: none. `level`: 1 error, 2 warning,
// 3 information. It is the only state that is not of an object.
void nsp_set_log(void (*log)(void *user, int32_t level, const char *line), void *user);

// Sets the features that the library needs in the structs with which the host creates its device; clears none.
void nsp_require_features(VkPhysicalDeviceVulkan12Features *vulkan12, VkPhysicalDeviceVulkan13Features *vulkan13);

// The device extensions that make recording faster where the host enables them, and their number.
const char *const *nsp_device_extensions(uint32_t *count);

// Whether the library can use a physical device; the error names what is missing.
NspResult nsp_check_device(PFN_vkGetInstanceProcAddr get_instance_proc_addr,
                           VkInstance instance,
                           VkPhysicalDevice physical_device);

// Takes a device that the host lends. It submits nothing.
NspResult nsp_device_from_host(const struct NspHostDevice *host, struct NspDevice **device);

// Opens a device of our own, for training without a host's: `choice` is what `nightsplat --device` takes, NULL or
// empty for the best.
NspResult nsp_device_open(const char *choice, struct NspDevice **device);

// Tells that the host's device is done with all frames up to `frame`, or that those left were never submitted, and
// frees what they used. `UINT64_MAX`: all there ever were, also after the host lost its device.
NspResult nsp_frames_done(struct NspDevice *device, uint64_t frame);

// Destroys a device. Every frame is done by then; it waits for none.
void nsp_device_destroy(struct NspDevice *device);

// The camera of an engine's matrices, column by column, for Vulkan's clip space (x right, y down, depth 0 to 1 or
// reversed). The view space may look along z or against it, with y up or down. `width` and `height`: the viewport,
// pixels.
//
// Errors: `NSP_ERROR_USAGE` where the projection is orthographic or sheared, or the view is not rigid.
NspResult nsp_camera_from_matrices(const float *view,
                                   const float *projection,
                                   uint32_t width,
                                   uint32_t height,
                                   struct NspCamera *camera);

// Loads a model: PLY, SPZ, SOG, or a run directory. The upload is part of the next recording.
NspResult nsp_model_load(struct NspDevice *device, const char *path, struct NspModel **model);

// Makes a model of arrays: means (count, 3); rotations (count, 4) as w, x, y, z; natural logarithms of scales
// (count, 3); opacities before the sigmoid (count); SH of degree 0 (count, 3); SH above it (count,
// (degree + 1)^2 - 1, 3), NULL for degree 0.
NspResult nsp_model_create(struct NspDevice *device,
                           uint32_t count,
                           uint32_t sh_degree,
                           const float *const *planes,
                           struct NspModel **model);

// Joins models into one, each moved by a rotation and translation (three rows of four), so that all are sorted
// together. Near plane, alpha limit and colours are the first one's, and the others have the same colours and limit.
NspResult nsp_model_join(struct NspDevice *device,
                         const struct NspModel *const *models,
                         const double (*poses)[12],
                         uint32_t count,
                         struct NspModel **model);

// The number of Gaussians; 0 for NULL.
uint32_t nsp_model_count(const struct NspModel *model);

// Fills `info`.
NspResult nsp_model_info(const struct NspModel *model, struct NspModelInfo *info);

// Destroys a model; frames that show it may be in flight.
void nsp_model_destroy(struct NspModel *model);

// Makes a renderer for models with the SH degree, near plane, colours and law of `model`.
NspResult nsp_renderer_create(struct NspDevice *device, const struct NspModel *model, struct NspRenderer **renderer);

// Takes memory for views of this size, and for this many intersections, ahead of the first recording.
NspResult nsp_renderer_reserve(struct NspRenderer *renderer, uint32_t width, uint32_t height, uint32_t intersections);

// Records the render of a model. It submits nothing and waits for nothing; where memory is too small for the view,
// the nearest splats are drawn, and a later call grows it.
//
// It binds compute pipelines, descriptors of set 0 and push constants, and restores none of them.
NspResult nsp_record_render(struct NspRenderer *renderer, const struct NspModel *model, const struct NspRender *render);

// Fills `status` with how the newest frame that is done went. It never waits.
NspResult nsp_renderer_status(const struct NspRenderer *renderer, struct NspStatus *status);

// Destroys a renderer; its frames may be in flight.
void nsp_renderer_destroy(struct NspRenderer *renderer);

// Begins a training on a dataset's folder. `config_toml` holds settings as config.toml does; NULL or empty: the
// photographs decide. The device is not record-only.
NspResult nsp_trainer_create(struct NspDevice *device,
                             const char *dataset,
                             const char *config_toml,
                             struct NspTrainer **trainer);

// Trains for about half a second, to step `until` at most. `steps` gets the last `*count` steps of those made, and
// `*count` how many it got; both may be NULL. Fewer than asked for, none included: the training has ended.
NspResult nsp_trainer_advance(struct NspTrainer *trainer, uint64_t until, struct NspStep *steps, uint32_t *count);

// A copy of the model as it is now, on the trainer's device.
NspResult nsp_trainer_model(struct NspTrainer *trainer, struct NspModel **model);

// Writes the model as it is now, in the format of the path's extension: `.ply`, `.spz`, `.sog` or `.glb`.
NspResult nsp_trainer_save(struct NspTrainer *trainer, const char *path);

// Destroys a trainer; waits for its own work.
void nsp_trainer_destroy(struct NspTrainer *trainer);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* NIGHTSPLAT_H */
