/* through_dds TYPE IN OUT: hand the CDR in IN to Cyclone DDS in the way that zenoh-bridge-ros2dds
 * does, take it as C, write that again, and put the CDR that DDS makes of it into OUT.
 * Status 3: DDS refuses the bytes.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "dds/dds.h"
#include "dds/ddsi/ddsi_serdata.h"
#include "ros.h"

#define REFUSED 3

static const struct {
  const char *name;
  const dds_topic_descriptor_t *descriptor;
} types[] = {
    {"Twist", &geometry_msgs_msg_dds__Twist__desc},
    {"Odometry", &nav_msgs_msg_dds__Odometry__desc},
    {"AckermannDriveStamped", &ackermann_msgs_msg_dds__AckermannDriveStamped__desc},
};

static void check(dds_return_t status, const char *what) {
  if (status < 0) {
    fprintf(stderr, "%s: %s\n", what, dds_strretcode(-status));
    exit(1);
  }
}

static const dds_topic_descriptor_t *descriptor_of(const char *name) {
  for (size_t i = 0; i < sizeof types / sizeof *types; i++)
    if (strcmp(types[i].name, name) == 0) return types[i].descriptor;
  fprintf(stderr, "no type %s\n", name);
  exit(1);
}

static struct ddsi_serdata *take_cdr(dds_entity_t reader) {
  struct ddsi_serdata *data[1];
  dds_sample_info_t info[1];
  check(dds_takecdr(reader, data, 1, info, DDS_ANY_STATE) == 1 ? 0 : DDS_RETCODE_NO_DATA, "takecdr");
  return data[0];
}

int main(int argc, char **argv) {
  static unsigned char bytes[1 << 20];
  if (argc != 4) return 2;
  FILE *file = fopen(argv[2], "rb");
  if (file == NULL) return 2;
  size_t size = fread(bytes, 1, sizeof bytes, file);
  fclose(file);

  const dds_topic_descriptor_t *descriptor = descriptor_of(argv[1]);
  dds_entity_t participant = dds_create_participant(DDS_DOMAIN_DEFAULT, NULL, NULL);
  check(participant, "participant");
  dds_qos_t *qos = dds_create_qos();
  dds_qset_reliability(qos, DDS_RELIABILITY_RELIABLE, DDS_SECS(1));
  dds_data_representation_id_t plain[1] = {DDS_DATA_REPRESENTATION_XCDR1};
  dds_qset_data_representation(qos, 1, plain);
  dds_entity_t topic = dds_create_topic(participant, descriptor, "rt/test", NULL, NULL);
  check(topic, "topic");
  dds_entity_t reader = dds_create_reader(participant, topic, qos, NULL);
  check(reader, "reader");
  dds_entity_t writer = dds_create_writer(participant, topic, qos, NULL);
  check(writer, "writer");

  /* Its serializer comes with any sample of the type. */
  check(dds_write(writer, calloc(1, descriptor->m_size)), "write zeros");
  const struct ddsi_sertype *type = take_cdr(reader)->type;

  ddsrt_iovec_t part = {.iov_base = bytes, .iov_len = size};
  struct ddsi_serdata *ours = ddsi_serdata_from_ser_iov(type, SDK_DATA, 1, &part, size);
  if (ours == NULL) return REFUSED;
  check(dds_writecdr(writer, ours), "writecdr");
  void *sample[1] = {NULL};
  dds_sample_info_t info[1];
  check(dds_take(reader, sample, info, 1, 1) == 1 ? 0 : DDS_RETCODE_NO_DATA, "take");
  check(dds_write(writer, sample[0]), "write");

  struct ddsi_serdata *theirs = take_cdr(reader);
  size = ddsi_serdata_size(theirs);
  ddsi_serdata_to_ser(theirs, 0, size, bytes);
  file = fopen(argv[3], "wb");
  if (file == NULL) return 2;
  fwrite(bytes, 1, size, file);
  fclose(file);
  puts(type->type_name);
  dds_delete(participant);
  return 0;
}
